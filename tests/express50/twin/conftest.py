import dataclasses

import pytest
import torch

from express50.twin import TwinConfig
from express50.twin.record import record

SMALL = TwinConfig(
    subjects=1,
    cameras=3,
    width=96,
    height=96,
    expressions=("neutral", "jaw_open"),
    frames_per_expression=5,
    board_frames=2,
    footage="png",
    seed=3,
)


@pytest.fixture(scope="session")
def small_config():
    return SMALL


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """One subject, three cameras, ten frames; recorded once."""
    torch.set_num_threads(1)
    out = tmp_path_factory.mktemp("twin")
    record(SMALL, out, workers=1)
    return out


@pytest.fixture(scope="session")
def tiny_config():
    return dataclasses.replace(
        SMALL,
        cameras=2,
        width=48,
        height=40,
        expressions=("smile",),
        frames_per_expression=4,
        board_frames=1,
    )
