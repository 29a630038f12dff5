"""Measure what the runner adds to an item: fingerprints, folders, receipts.

``python -m benchmarks.stage_overhead`` runs a stage that does nothing over many items: in this
process, in two worker processes (their start not counted) with every item alone and in batches, as
the runner has them, and once more when all is current. The last line printed is one JSON object.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import express50.runner.executor
from benchmarks.common import make_parser
from benchmarks.fault_stage import inputs, items, write_inputs
from express50.contract.config import build_config
from express50.contract.layout import Dataset
from express50.contract.stage import Result, Stage
from express50.runner.executor import LARGEST_BATCH, Pool
from express50.runner.runner import run_stage


@dataclass(frozen=True, kw_only=True)
class EmptyConfig:
    """Nothing to set."""


def run(dataset: Dataset, item: str, config: EmptyConfig, out: Path) -> Result:
    """Write nothing."""
    return Result()


STAGE = Stage(name="empty", version=1, config=EmptyConfig, items=items, inputs=inputs, run=run)


def main(arguments: list[str] | None = None) -> int:
    """Measure and print."""
    parser = make_parser("stage_overhead", __doc__)
    parser.add_argument("--items", type=int, default=500)
    count = parser.parse_args(arguments).items
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as scratch:
        names = ("inline", "alone", "workers")
        inline, alone, workers = (write_inputs(Path(scratch) / name, count) for name in names)
        result = {
            "milliseconds_per_item": timed(inline, Pool(0), count),
            "milliseconds_per_current_item": timed(inline, Pool(0), count),
            "milliseconds_per_item_two_workers_alone": with_workers(alone, count, 1),
            "milliseconds_per_item_two_workers": with_workers(workers, count, LARGEST_BATCH),
            "milliseconds_per_write_and_sync": syncs(Path(scratch) / "sync", count),
            "items": count,
        }
    print(json.dumps(result))
    return 0


def with_workers(dataset: Dataset, count: int, batch: int) -> float:
    """Return milliseconds per item in two running workers, in batches of at most so many."""
    express50.runner.executor.LARGEST_BATCH = batch
    first = write_inputs(dataset.root / "first", 4)
    with Pool(2) as pool:
        timed(first, pool, 4)
        return timed(dataset, pool, count)


def timed(dataset: Dataset, pool: Pool, count: int) -> float:
    """Return milliseconds per item, by the clock: waiting for the disk counts."""
    began = time.perf_counter()
    summary = run_stage(STAGE, dataset, build_config(STAGE, {}), progress=False, pool=pool)
    seconds = time.perf_counter() - began
    assert summary.ok
    return round(1e3 * seconds / count, 3)


def syncs(folder: Path, count: int) -> float:
    """Return milliseconds that one small file takes to the disk here: an item cannot cost less."""
    folder.mkdir()
    began = time.perf_counter()
    for number in range(count):
        with (folder / f"{number}").open("wb") as file:
            file.write(b"{}\n")
            file.flush()
            os.fsync(file.fileno())
    return round(1e3 * (time.perf_counter() - began) / count, 3)


if __name__ == "__main__":
    sys.exit(main())
