"""The ingest stage writes a capture's frame index and proxies, and checks its quality."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from express50.console import count
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Result, Stage
from express50.errors import FormatError
from express50.files.text import read_json_table
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


def account(dataset: Dataset, subjects: Sequence[str]) -> Iterator[str]:
    """Yield a line per ingested capture for people."""
    for subject in subjects:
        path = dataset.item_dir("ingest", subject) / "metrics.json"
        if not path.is_file():
            continue
        found = read_json_table(path, FormatError, "ingest again")
        counts = sorted({found["frame_count"], *found["frame_count_differs"].values()})
        frames = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
        frames += " frame each" if counts == [1] else " frames each"
        yield (
            f"  {subject} ({found.get('layout', 'express50')}): "
            f"{count(found['cameras'], 'camera')}, {frames}, "
            f"{count(found['expressions'], 'expression')}"
        )


STAGE = Stage(
    name="ingest",
    version=5,
    config=IngestConfig,
    presets=PRESETS,
    items=items,
    inputs=inputs,
    run=run,
    help="index raw captures: frames, hashes, proxies",
    purpose="Footage indexed frame by frame, with proxies for scrubbing.",
    prepare=register,
    account=account,
    # Proxies have one size, whatever that of the footage.
    growth=Growth(("subjects",), ("frames", "views", "pixels"), ("frames", "views")),
)
