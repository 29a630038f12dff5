"""A stage for injecting faults: its items take a while, and record when they were worked on.

``python -m benchmarks.fault_stage ROOT NOTES --workers N [--scheduler ADDRESS]``

What may go wrong is in the environment, so that workers see it too: ``FAULT_LATE`` seconds by which
renames are late, ``FAULT_CLOCK`` seconds by which the clock is wrong, ``FAULT_HUNGRY`` and
``FAULT_FULL`` items that take much memory in their first try, or find the disk full.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.common import make_parser
from express50.contract.config import build_config
from express50.contract.layout import Dataset
from express50.contract.stage import Result, Stage
from express50.errors import Express50Error
from express50.files import atomic
from express50.files.atomic import dump_json
from express50.runner.executor import Pool
from express50.runner.runner import run_stage

PIECES = 4
HUNGER = 500_000_000  # bytes
LATE_RENAME = """
import ctypes, os, sys, time
seconds, one, other, flags = sys.argv[1:]
time.sleep(float(seconds))
libc = ctypes.CDLL(None, use_errno=True)
done = libc.renameat2(-100, os.fsencode(one), -100, os.fsencode(other), int(flags))
sys.exit(ctypes.get_errno() if done else 0)
"""


@dataclass(frozen=True, kw_only=True)
class FaultConfig:
    """What an item does."""

    seconds: float = 0.25
    """How long an item takes."""
    notes: str = ""
    """Folder for the times of the work, outside the dataset."""


def write_inputs(root: Path, count: int) -> Dataset:
    """Make a dataset of so many small inputs, one per item."""
    (root / "in").mkdir(parents=True)
    for number in range(count):
        (root / "in" / f"item{number:05d}.txt").write_text(f"{number + 10}")
    return Dataset(root)


def items(dataset: Dataset) -> list[str]:
    """List the names of the input files."""
    return sorted(path.stem for path in (dataset.root / "in").glob("*.txt"))


def inputs(dataset: Dataset, item: str, config: object) -> dict[str, Path | str]:
    """Return the item's file."""
    return {"text": dataset.root / "in" / f"{item}.txt"}


def outputs(text: bytes) -> dict[str, bytes]:
    """Return the files of an item, except its metrics."""
    pieces = (hashlib.sha256(text + b"%d" % number).digest() * 4000 for number in range(PIECES))
    return {f"{number}.bin": piece for number, piece in enumerate(pieces)}


def expected(dataset: Dataset) -> dict[str, dict[str, bytes]]:
    """Return the files that every item must have in the end."""
    texts = {item: (dataset.root / "in" / f"{item}.txt").read_bytes() for item in items(dataset)}
    return {
        item: outputs(text) | {"metrics.json": dump_json(Result({"length": len(text)}).to_json())}
        for item, text in texts.items()
    }


def run(dataset: Dataset, item: str, config: FaultConfig, out: Path) -> Result:
    """Write a few files with pauses between them."""
    text = (dataset.root / "in" / f"{item}.txt").read_bytes()
    note = Path(config.notes) / f"{item}-{os.getpid()}-{time.clock_gettime_ns(time.CLOCK_REALTIME)}"
    tried = any(Path(config.notes).glob(f"{item}-*"))
    note.touch()
    for name, piece in outputs(text).items():
        (out / name).write_bytes(piece)
        time.sleep(config.seconds / PIECES)
        os.utime(note)  # how far the work got, if it is stopped
        if os.environ.get("FAULT_FULL") == item:
            Path("/dev/full").write_bytes(piece)
        if os.environ.get("FAULT_HUNGRY") == item and not tried:
            hoard = bytearray(b"x") * HUNGER
            time.sleep(30)
            del hoard
    note.rename(note.with_suffix(".done"))
    return Result({"length": len(text)})


def rename_late(seconds: str, one: object, other: object, flags: int = 0) -> int:
    """Rename by a process that outlives this one; returns the error's number."""
    command = [sys.executable, "-S", "-c", LATE_RENAME, seconds, str(one), str(other), str(flags)]
    return subprocess.run(command, check=False, start_new_session=True).returncode


def hurt() -> None:
    """Make late renames and a wrong clock of the environment's settings."""
    late, clock = os.environ.get("FAULT_LATE"), float(os.environ.get("FAULT_CLOCK", "0"))
    rename, now = os.rename, time.time
    if clock:
        time.time = lambda: now() + clock

    def renamed(one: Any, other: Any, **options: Any) -> None:
        if not late or ".staging" not in str(one) or not Path(str(one)).is_dir():
            rename(one, other, **options)
        elif error := rename_late(late, one, other):
            raise OSError(error, os.strerror(error), str(one), None, str(other))

    if late:
        vars(os)["rename"] = renamed
        atomic._swap = lambda one, other: not rename_late(late, one, other, atomic.RENAME_EXCHANGE)


hurt()


STAGE = Stage(name="faults", version=1, config=FaultConfig, items=items, inputs=inputs, run=run)


def main() -> int:
    """Run the stage once."""
    parser = make_parser("fault_stage", __doc__)
    parser.add_argument("root", type=Path)
    parser.add_argument("notes")
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--scheduler")
    args = parser.parse_args()
    config = build_config(STAGE, {"notes": args.notes})
    try:
        with Pool(args.workers, args.scheduler) as pool:
            summary = run_stage(STAGE, Dataset(args.root), config, pool=pool, progress=False)
    except Express50Error as error:
        print(error, file=sys.stderr)
        return 2
    return 0 if summary.ok else 1


if __name__ == "__main__":
    # Workers must find the stage by its module, not as what was run.
    from benchmarks.fault_stage import main as found

    sys.exit(found())
