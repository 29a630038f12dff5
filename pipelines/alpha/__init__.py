"""Opacity in peak frames, each camera by itself: keyed against its plate, or by a network."""

from __future__ import annotations

from pathlib import Path

from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage
from pipelines.alpha.config import PRESETS, AlphaConfig


def items(dataset: Dataset) -> list[str]:
    """List the items, see `pipelines.alpha.stage`."""
    from pipelines.alpha.stage import items as found

    return found(dataset)


def inputs(dataset: Dataset, item: str, config: AlphaConfig) -> dict[str, Path | str]:
    """Name what one item reads, see `pipelines.alpha.stage`."""
    from pipelines.alpha.stage import inputs as found

    return found(dataset, item, config)


def run(dataset: Dataset, item: str, config: AlphaConfig, out: Path) -> Result | dict:
    """Make one item, see `pipelines.alpha.stage`."""
    from pipelines.alpha.stage import run as work

    return work(dataset, item, config, out)


def needs_gpu(config: AlphaConfig) -> bool:
    """Say whether a network must run on CUDA."""
    from pipelines.alpha.stage import needs_gpu as found

    return found(config)


STAGE = Stage(
    name="alpha",
    version=5,
    config=AlphaConfig,
    presets=PRESETS,
    items=items,
    inputs=inputs,
    run=run,
    needs_gpu=needs_gpu,
    help="separate the head from the background, each camera alone (matte runs it first)",
    purpose="Alpha of every peak frame, each camera by itself.",
    growth=Growth(
        items=("subjects", "views"), time=("expressions", "pixels"), disk=("expressions", "pixels")
    ),
)
