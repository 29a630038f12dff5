"""The observe stage finds landmarks and aligned faces in every frame of a cue window.

Item: a subject. This is the slow half of ``express50 align``, which runs it first. Suggesting and
matching read only these files, so a new label or another reference does not need the
footage again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from express50.contract.config import check_ranges
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage


@dataclass(frozen=True, kw_only=True)
class ObserveConfig:
    """Settings of the observe stage."""

    cameras: int = 3
    """Number of cameras to use: those that see the face best at rest."""
    stride: int = 1
    """Use every n-th frame of a cue window, 1 or more."""
    min_score: float = 0.3
    """Leave out cameras whose face score at rest is lower, 0 to 1."""
    search: float = 0.25
    """Smallest windows searched where no face is found, as a share of the image's longer side; at
    most 0.08 if no camera then shows one."""

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check_ranges(
            "observe", self, cameras=(1, math.inf), stride=(1, math.inf),
            min_score=(0, 1), search=(0.02, 1),
        )  # fmt: skip


def inputs(dataset: Dataset, item: str, config: ObserveConfig) -> dict[str, Path | str]:
    """List the subject's index and proxies, and the landmark network's weights."""
    from express50.landmarks import WEIGHTS

    return {"ingest": dataset.item_dir("ingest", item), "weights": WEIGHTS}


def run(dataset: Dataset, item: str, config: ObserveConfig, out: Path) -> Result:
    """Write ``observations.npz`` and a picture of the watching cameras at rest."""
    from annotations.observe.stage import run as work

    return work(dataset, item, out, **vars(config))


STAGE = Stage(
    name="observe",
    version=3,
    config=ObserveConfig,
    presets={"draft": {"cameras": 1, "stride": 2}},
    items=Dataset.subjects,
    inputs=inputs,
    run=run,
    help="find the face in every frame of the cue windows (align runs this first)",
    purpose="The cameras that watch the face through the cue windows.",
    growth=Growth(items=("subjects",), time=("frames",), disk=("frames",)),
)
