"""Ingest: the frame index, proxies and a first look at sync, light and focus of a capture."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage
from pipelines.ingest.config import PRESETS, IngestConfig


def register(dataset: Dataset, captures: Sequence[Path]) -> list[str]:
    """Add captures to the dataset's table, see `pipelines.ingest.stage`."""
    from pipelines.ingest.stage import register as work

    return work(dataset, list(captures))


def items(dataset: Dataset) -> list[str]:
    """List the registered subjects."""
    return list(dataset.captures())


def inputs(dataset: Dataset, item: str, config: IngestConfig) -> dict[str, Path | str]:
    """Name what one item reads, see `pipelines.ingest.stage`."""
    from pipelines.ingest.stage import inputs as found

    return found(dataset, item, config)


def run(dataset: Dataset, item: str, config: IngestConfig, out: Path) -> Result:
    """Make one item, see `pipelines.ingest.stage`."""
    from pipelines.ingest.stage import run as work

    return work(dataset, item, config, out)


def account(dataset: Dataset, subjects: Sequence[str]) -> Iterable[str]:
    """Say what was found in captures, see `pipelines.ingest.stage`."""
    from pipelines.ingest.stage import account as lines

    return lines(dataset, list(subjects))


STAGE = Stage(
    name="ingest",
    version=4,
    config=IngestConfig,
    presets=PRESETS,
    items=items,
    inputs=inputs,
    run=run,
    help="index raw captures: frames, hashes, proxies",
    purpose="Footage indexed frame by frame, with proxies for scrubbing.",
    prepare=register,
    account=account,
    # Proxies, and what is seen in them, have one size whatever the footage has.
    growth=Growth(("subjects",), ("frames", "views", "pixels"), ("frames", "views")),
)
