"""Packing: cropped samples of every subject, expression and camera into checksummed shards."""

from __future__ import annotations

from pathlib import Path

from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage
from pipelines.pack.config import PRESETS, PackConfig


def items(dataset: Dataset) -> list[str]:
    """List the items, see `pipelines.pack.stage`."""
    from pipelines.pack.stage import items as found

    return found(dataset)


def inputs(dataset: Dataset, item: str, config: PackConfig) -> dict[str, Path | str]:
    """Name what one item reads, see `pipelines.pack.stage`."""
    from pipelines.pack.stage import inputs as found

    return found(dataset, item, config)


def run(dataset: Dataset, item: str, config: PackConfig, out: Path) -> Result | dict:
    """Make one item, see `pipelines.pack.stage`."""
    from pipelines.pack.stage import run as work

    return work(dataset, item, config, out)


STAGE = Stage(
    name="pack",
    version=8,
    config=PackConfig,
    presets=PRESETS,
    items=items,
    inputs=inputs,
    run=run,
    help="write shards, splits and dataset card",
    purpose="Samples packed into shards.",
    growth=Growth(
        items=(),
        time=("subjects", "expressions", "views", "pixels"),
        disk=("subjects", "expressions", "views"),
    ),
)
