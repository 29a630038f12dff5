"""Calibration of a rig: given cameras are checked, others are solved from ChArUco images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from express50.contract.extensions import Command
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage
from pipelines.calibrate.config import PRESETS, CalibrateConfig


def items(dataset: Dataset) -> list[str]:
    """List the items, see `pipelines.calibrate.stage`."""
    from pipelines.calibrate.stage import items as found

    return found(dataset)


def inputs(dataset: Dataset, item: str, config: CalibrateConfig) -> dict[str, Path | str]:
    """Name what one item reads, see `pipelines.calibrate.stage`."""
    from pipelines.calibrate.stage import inputs as found

    return found(dataset, item, config)


def run(dataset: Dataset, item: str, config: CalibrateConfig, out: Path) -> Result | dict:
    """Make one item, see `pipelines.calibrate.stage`."""
    from pipelines.calibrate.stage import run as work

    return work(dataset, item, config, out)


STAGE = Stage(
    name="calibrate",
    version=3,
    config=CalibrateConfig,
    presets=PRESETS,
    items=items,
    inputs=inputs,
    run=run,
    help="take or solve the cameras",
    purpose="Cameras: given, or solved from the board or the footage.",
    growth=Growth(items=("subjects",), time=("views", "pixels"), disk=("views",)),
)


def add_commands(subparsers: Any) -> None:
    """Add the command, see `pipelines.calibrate.cli`."""
    from pipelines.calibrate.cli import add_commands as add

    add(subparsers)


COMMAND = Command("import and check calibrations", add_commands)
