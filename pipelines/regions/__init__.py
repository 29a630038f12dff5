"""Labels of what each pixel of a peak frame shows, and the head's own matte without the torso."""

from __future__ import annotations

from pathlib import Path

from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage
from pipelines.regions.config import PRESETS, RegionsConfig


def items(dataset: Dataset) -> list[str]:
    """List the items, see `pipelines.regions.stage`."""
    from express50.capture.frames import peak_items as found

    return found(dataset)


def inputs(dataset: Dataset, item: str, config: RegionsConfig) -> dict[str, Path | str]:
    """Name what one item reads, see `pipelines.regions.stage`."""
    from pipelines.regions.stage import inputs as found

    return found(dataset, item, config)


def run(dataset: Dataset, item: str, config: RegionsConfig, out: Path) -> Result | dict:
    """Make one item, see `pipelines.regions.stage`."""
    from pipelines.regions.stage import run as work

    return work(dataset, item, config, out)


def needs_gpu(config: RegionsConfig) -> bool:
    """Say whether a network must run on CUDA."""
    from pipelines.regions.stage import needs_gpu as found

    return found(config)


STAGE = Stage(
    name="regions",
    version=2,
    config=RegionsConfig,
    presets=PRESETS,
    items=items,
    inputs=inputs,
    run=run,
    needs_gpu=needs_gpu,
    help="label skin, hair, eyes, mouth, neck and torso; cut the head off the torso",
    purpose="Labels of every pixel of a peak frame, and the head without the torso.",
    growth=Growth(
        items=("subjects", "expressions"), time=("views", "pixels"), disk=("views", "pixels")
    ),
)
