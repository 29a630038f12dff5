"""Tracking: a head model is fitted to every peak frame of a subject, seen by all its cameras."""

from __future__ import annotations

from pathlib import Path

from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage
from pipelines.track.config import PRESETS, VERSION, TrackConfig


def items(dataset: Dataset) -> list[str]:
    """List the items, see `pipelines.track.stage`."""
    from pipelines.track.stage import items as found

    return found(dataset)


def inputs(dataset: Dataset, item: str, config: TrackConfig) -> dict[str, Path | str]:
    """Name what one item reads, see `pipelines.track.stage`."""
    from pipelines.track.stage import inputs as found

    return found(dataset, item, config)


def run(dataset: Dataset, item: str, config: TrackConfig, out: Path) -> Result | dict:
    """Make one item, see `pipelines.track.stage`."""
    from pipelines.track.stage import run as work

    return work(dataset, item, config, out)


STAGE = Stage(
    name="track",
    version=VERSION,
    config=TrackConfig,
    presets=PRESETS,
    items=items,
    inputs=inputs,
    run=run,
    help="fit the head model to the peak frames",
    purpose="The head model fitted to landmarks in all views.",
    growth=Growth(
        items=("subjects",), time=("expressions", "views", "pixels"), disk=("expressions",)
    ),
)
