"""Run a stage whose items take a while and note when they were worked on, to be killed.

``python -m benchmarks.fault_stage ROOT NOTES --workers N [--scheduler ADDRESS]``
"""

from __future__ import annotations

import argparse
import hashlib
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from express50.contract.config import build_config
from express50.contract.layout import Dataset
from express50.contract.stage import Result, Stage
from express50.errors import Express50Error
from express50.runner.runner import run_stage

PIECES = 4


@dataclass(frozen=True, kw_only=True)
class FaultConfig:
    """What an item does."""

    seconds: float = 0.25
    """How long an item takes."""
    notes: str = ""
    """Folder for the times of the work, outside the dataset."""


def items(dataset: Dataset) -> list[str]:
    """Name of the input files."""
    return sorted(path.stem for path in (dataset.root / "in").glob("*.txt"))


def inputs(dataset: Dataset, item: str, config: FaultConfig) -> dict[str, Path | str]:
    """Return the item's file."""
    return {"text": dataset.root / "in" / f"{item}.txt"}


def run(dataset: Dataset, item: str, config: FaultConfig, out: Path) -> Result:
    """Write a few files with pauses between them."""
    text = (dataset.root / "in" / f"{item}.txt").read_bytes()
    note = Path(config.notes) / f"{item}-{os.getpid()}-{time.time_ns()}"
    note.touch()
    for number in range(PIECES):
        (out / f"{number}.bin").write_bytes(hashlib.sha256(text + b"%d" % number).digest() * 4000)
        time.sleep(config.seconds / PIECES)
        os.utime(note)  # how far the work got, if it is stopped
    note.rename(note.with_suffix(".done"))
    return Result({"length": len(text)})


STAGE = Stage(
    name="faults",
    version=1,
    config=FaultConfig,
    items=items,
    inputs=inputs,
    run=run,
)


def main() -> int:
    """Run the stage once."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fault_stage", description=__doc__)
    parser.add_argument("root", type=Path)
    parser.add_argument("notes")
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--scheduler")
    args = parser.parse_args()
    config = build_config(STAGE, {"notes": args.notes})
    try:
        summary = run_stage(
            STAGE, Dataset(args.root), config, None, args.workers, args.scheduler, progress=False
        )
    except Express50Error as error:
        print(error, file=sys.stderr)
        return 2
    return 0 if summary.ok else 1


if __name__ == "__main__":
    # Workers must find the stage by its module, not as what was run.
    from benchmarks.fault_stage import main as found

    sys.exit(found())
