"""A dataset of painted frames: two subjects, and suggestions as align writes them."""

import pytest

from express50.contract.layout import Dataset
from tests.annotations.footage import EXPRESSIONS, suggest
from tests.stages import ingest_captures
from tests.synth import make_capture


@pytest.fixture(scope="session")
def footage(tmp_path_factory):
    """An ingested dataset of S001 and S002: 2 cameras, 3 expressions of 16 frames; only copied."""
    root = tmp_path_factory.mktemp("annotator")
    captures = []
    for subject in ("S001", "S002"):
        captures.append(root / subject)
        make_capture(
            captures[-1], subject=subject, cameras=2, frames=48, size=32, plates=False,
            calibration=False, expressions=EXPRESSIONS,
        )  # fmt: skip
    return ingest_captures(root / "dataset", *captures)


@pytest.fixture
def dataset(footage, tmp_path):
    """The footage without suggestions; labels go to a folder of its own."""
    root = tmp_path / "dataset"
    root.mkdir()
    for name in ("ingest", "captures.json"):
        (root / name).symlink_to(footage.root / name)
    return Dataset(root)


@pytest.fixture
def suggested(dataset):
    """The footage with suggestions for every expression of both subjects."""
    rows = {"neutral": [4], "smile": [20, 27], "jaw_open": [40, 36, 45]}
    suggest(dataset, {"S001": rows, "S002": rows})
    return dataset
