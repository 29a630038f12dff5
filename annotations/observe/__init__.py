"""The observe stage: landmarks and aligned faces of every frame in a cue window.

Item: a subject. This is the slow half of ``express50 align``, which runs it first. Suggesting and
matching read only what is written here, so that a new label or another reference does not need the
footage again.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage
from express50.errors import FormatError, StageError
from express50.files.arrays import read_arrays

SCHEMA = "express50.observations/1"
NEUTRAL = "neutral"
SEEN_SCORE = 0.15  # of a frame that shows the face at all


@dataclass(frozen=True, kw_only=True)
class ObserveConfig:
    """Settings of the observe stage."""

    cameras: int = 3
    """How many cameras watch the face; those that see it best at rest are taken."""
    stride: int = 1
    """Look at every stride-th frame of a cue window, at least 1."""
    min_score: float = 0.3
    """Leave out cameras whose face score at rest is lower, 0 to 1."""
    search: float = 0.25
    """Smallest windows searched where no face is found, as a share of the image's longer side."""

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        if self.cameras < 1 or self.stride < 1:
            raise ValueError(f"cameras {self.cameras}, stride {self.stride}: expected at least 1")
        if not 0 <= self.min_score <= 1:
            raise ValueError(f"min_score {self.min_score}: expected 0 to 1")
        if not 0.02 <= self.search <= 1:
            raise ValueError(f"search {self.search}: expected 0.02 to 1")


@dataclass(frozen=True)
class FaceObservations:
    """The faces that C cameras saw of a subject in F frames.

    Attributes:
        cameras: ids, the one that sees the face best first.
        frames: (F,) frame numbers, increasing.
        points: (C, F, 68, 2) landmarks in proxy pixels.
        scores: (C, F) face scores, 0 to 1.
        faces: (C, F, S, S) uint8 grey, head motion removed.
    """

    cameras: tuple[str, ...]
    frames: np.ndarray
    points: np.ndarray
    scores: np.ndarray
    faces: np.ndarray


def observations_path(dataset: Dataset, subject: str) -> Path:
    """Return the file of a subject's observations."""
    return dataset.item_dir("observe", subject) / "observations.npz"


def read_observations(dataset: Dataset, subject: str) -> FaceObservations:
    """Read what the stage wrote.

    Raises:
        StageError: the subject was not observed.
        FormatError: the file is damaged or of another version.
    """
    path = observations_path(dataset, subject)
    if not path.is_file():
        raise StageError(f"{path}: {subject!r} is not observed; run 'express50 align' on it")
    try:
        table = read_arrays(path, FormatError, "observations", mend="run 'express50 align'")
        if str(table["schema"]) != SCHEMA:
            raise ValueError(f"schema is {table['schema']}, expected {SCHEMA}")
        rest = (table[key] for key in ("frames", "points", "scores", "faces"))
        return FaceObservations(tuple(map(str, table["cameras"])), *rest)
    except (ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{path}: no observations ({error}); run 'express50 align'") from None


def inputs(dataset: Dataset, item: str, config: ObserveConfig) -> dict[str, Path | str]:
    """List the subject's index and proxies, and the landmark network's weights."""
    from express50.landmarks.network import WEIGHTS

    return {"ingest": dataset.item_dir("ingest", item), "weights": WEIGHTS}


def run(dataset: Dataset, item: str, config: ObserveConfig, out: Path) -> Result:
    """Write ``observations.npz`` and a picture of the watching cameras at rest."""
    from annotations.observe.stage import run as work

    return work(dataset, item, config, out)


STAGE = Stage(
    name="observe",
    version=2,
    config=ObserveConfig,
    presets={"draft": {"cameras": 1, "stride": 2}, "standard": {}, "reference": {}},
    items=Dataset.subjects,
    inputs=inputs,
    run=run,
    help="watch the face through every cue window (align runs it first)",
    purpose="The cameras that watch the face through the cue windows.",
    growth=Growth(items=("subjects",), time=("frames",), disk=("frames",)),
)
