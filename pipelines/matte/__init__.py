"""Mattes of a moment: what each camera keyed alone, corrected where the other cameras disagree."""

from __future__ import annotations

from pathlib import Path

from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage
from pipelines.matte.config import PRESETS, MatteConfig


def items(dataset: Dataset) -> list[str]:
    """List the items, see `pipelines.matte.stage`."""
    from express50.capture.frames import peak_items as found

    return found(dataset)


def inputs(dataset: Dataset, item: str, config: MatteConfig) -> dict[str, Path | str]:
    """Name what one item reads, see `pipelines.matte.stage`."""
    from pipelines.matte.stage import inputs as found

    return found(dataset, item, config)


def run(dataset: Dataset, item: str, config: MatteConfig, out: Path) -> Result | dict:
    """Make one item, see `pipelines.matte.stage`."""
    from pipelines.matte.stage import run as work

    return work(dataset, item, config, out)


STAGE = Stage(
    name="matte",
    version=5,
    config=MatteConfig,
    presets=PRESETS,
    items=items,
    inputs=inputs,
    run=run,
    help="let the cameras of a moment agree on their mattes",
    purpose="The matte that the cameras of a moment agree on: removed is red, filled is green.",
    runs_first=("alpha",),
    growth=Growth(
        items=("subjects", "expressions"), time=("views", "pixels"), disk=("views", "pixels")
    ),
)
