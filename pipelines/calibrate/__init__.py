"""The calibrate stage checks given cameras, or solves them from a board or from footage."""

from __future__ import annotations

from pathlib import Path

from express50.capture.index import calibration_file, read_index
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage
from pipelines.calibrate.config import LONG_SIDE, PRESETS, CalibrateConfig

__all__ = ["STAGE", "CalibrateConfig"]


def inputs(dataset: Dataset, item: str, config: CalibrateConfig) -> dict[str, Path | str]:
    """List the frame index, the landmark weights, and calibration and board images if given."""
    # Imported here, as everything heavy: listing the stages must stay quick.
    from express50.landmarks import WEIGHTS

    index = read_index(dataset, item)
    found: dict[str, Path | str] = {"index": dataset.index_file(item), "weights": WEIGHTS}
    given = calibration_file(dataset, index)
    if given is not None:
        found["calibration"] = given
    if index.board is not None:
        for files in index.board["cameras"].values():
            found |= {name: index.capture / name for name in files}
    return found


def run(dataset: Dataset, item: str, config: CalibrateConfig, out: Path) -> Result:
    """Write the cameras of one subject, plots, and from a board the cameras' colour gains."""
    from pipelines.calibrate.stage import run as work

    return work(dataset, item, config, out)


STAGE = Stage(
    name="calibrate",
    version=18,
    config=CalibrateConfig,
    presets=PRESETS,
    items=Dataset.subjects,  # a rig may be bumped between two: each has its own cameras
    inputs=inputs,
    run=run,
    help="use the given cameras, or solve them from a board or the footage",
    purpose="Cameras: given, or solved from the board or the footage.",
    growth=Growth(items=("subjects",), time=("views", "pixels"), disk=("views",), side=LONG_SIDE),
)
