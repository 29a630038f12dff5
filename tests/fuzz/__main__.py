"""Mutate every seed and print how its reader took it: ``python -m tests.fuzz [--cases N]``."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import torch

from tests.fuzz.apart import GOOD, judge, outcomes, say
from tests.fuzz.bombs import bombs
from tests.fuzz.mutations import Steps, draw_steps, mutate
from tests.fuzz.seeds import Reader, readers, write_seeds

WORDS = ("read", "refused", "traceback", "memory", "hang", "crash", "not finite", "not one line")


def main() -> int:
    """Print a row a reader: the outcomes, and with ``--json`` what went wrong too."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=32, help="mutated files a reader")
    parser.add_argument("--only", default="", help="readers whose name holds these words")
    parser.add_argument("--bombs", action="store_true", help="read the bombs too")
    parser.add_argument("--json", action="store_true", help="one JSON table")
    args = parser.parse_args()
    cv2.setNumThreads(0)
    torch.set_num_threads(1)
    steps = draw_steps(args.cases)
    table, ended = {}, {}
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "seeds"
        write_seeds(root)
        if args.bombs:
            ended = _bombs(root)
            shutil.rmtree(root)
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
        say(json.dumps({"bombs": ended, "readers": table}))
    elif args.bombs:
        say(json.dumps(ended, indent=1))
    return 0


def _bombs(root: Path) -> dict[str, str]:
    """How each ended, and whether one of them ran code."""
    cases = dict(bombs(root))
    ended = outcomes(list(cases.values()))
    table = {
        name: word if word == "refused" else f"{word}: {line}"
        for name, (word, line) in zip(cases, ended, strict=True)
    }
    ran = (root / "bombs/executed").exists()
    return table | {"nothing executed": "executed" if ran else "refused"}


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
    ended = outcomes([case(mutate(valid, s, reader.name)) for s in steps])
    counts = Counter(word for word, _ in ended)
    bad = [
        f"case {number}: {word}: {line[:300]}"
        for number, (word, line) in enumerate(ended)
        if word not in GOOD
    ]
    path.write_bytes(valid)
    for companion in path.parent.glob(f"{path.name}-*"):  # SQLite's journals
        companion.unlink()
    return {word: counts[word] for word in WORDS} | {"bad": bad, "native": reader.native}


if __name__ == "__main__":
    sys.exit(main())
