"""Mutate every seed and print how its reader took it: ``python -m tests.fuzz [--cases N]``."""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import torch

from tests.fuzz.apart import count_outcomes, judge, say
from tests.fuzz.mutations import Steps, draw_steps, mutate
from tests.fuzz.seeds import Reader, readers, write_seeds

WORDS = ("read", "refused", "traceback", "memory", "hang", "crash", "not finite", "not one line")


def main() -> int:
    """Print a row a reader: the outcomes, and with ``--json`` what went wrong too."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=32, help="mutated files a reader")
    parser.add_argument("--only", default="", help="readers whose name holds these words")
    parser.add_argument("--json", action="store_true", help="one JSON table")
    args = parser.parse_args()
    cv2.setNumThreads(0)
    torch.set_num_threads(1)
    steps = draw_steps(args.cases)
    table = {}
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "seeds"
        write_seeds(root)
        for reader in readers():
            if args.only not in reader.name:
                continue
            table[reader.name] = row = _row(reader, root, steps)
            if not args.json:
                counts = "  ".join(f"{w} {row[w]}" for w in WORDS if row[w])
                say(f"{reader.name:28s} {counts}")
                say("\n".join(f"    {line}" for line in dict.fromkeys(row["bad"])) or "    -")
    if args.json:
        say(json.dumps(table))
    return 0


def _row(reader: Reader, root: Path, steps: list[Steps]) -> dict:
    path = root / reader.file
    valid = path.read_bytes()

    def case(data: bytes) -> Callable[[], object]:
        def run() -> object:
            path.write_bytes(data)
            return reader.read(root)

        return run

    word, line = judge(lambda: reader.read(root))
    if word != "read":
        raise SystemExit(f"{reader.name}: the valid file is not read: {word}: {line}")
    counts, bad = count_outcomes([case(mutate(valid, s, reader.name)) for s in steps])
    path.write_bytes(valid)
    for companion in path.parent.glob(f"{path.name}-*"):  # SQLite's journals
        companion.unlink()
    return {word: counts[word] for word in WORDS} | {"bad": bad, "native": reader.native}


if __name__ == "__main__":
    sys.exit(main())
