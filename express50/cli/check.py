"""``express50 check`` audits a dataset against its ledger and sets aside what can be remade."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from express50.console import FAILED, OK, say, say_json, stdout_to_stderr
from express50.contract.extensions import hook, stages
from express50.contract.layout import Dataset
from express50.errors import StageError


def add_commands(subparsers: Any) -> None:
    """Add the ``check`` command."""
    parser = subparsers.add_parser(
        "check",
        help="audit a dataset against its ledger, and fix it",
        description="Compares every output with what was published (present, size, and SHA-256 "
        "where the time of change is another; --deep reads every byte), with the inputs and "
        "settings that are there now, looks for unfinished and unaccounted outputs, labels of "
        "frames that do not exist, captures that are gone, and traces of withdrawn people. Exit "
        "code 0 when nothing wrong is left, 1 otherwise.",
        epilog="example: express50 check DATASET --fix && express50 run DATASET",
    )
    parser.add_argument("dataset", type=Path, metavar="DATASET")
    parser.add_argument("--deep", action="store_true", help="read every byte of every output")
    parser.add_argument(
        "--fix",
        "--mend",
        action="store_true",
        help="set wrong outputs aside, so that their stage makes them again; delete leftovers",
    )
    parser.add_argument(
        "--checkpoint", type=Path, action="append", default=[], metavar="FILE",
        help="a model outside the dataset that may not name withdrawn people; may be repeated",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print as JSON")
    parser.set_defaults(handler=run_check)


def run_check(args: argparse.Namespace) -> int:
    """Print findings, notes and how much was looked at."""
    from express50.dataset.audit import audit

    started = time.perf_counter()
    if not (args.dataset / "ingest").exists() and not (args.dataset / "ledger.sqlite").exists():
        raise StageError(f"{args.dataset}: not a dataset; run 'express50 ingest' first")
    for path in args.checkpoint:
        hook("read_checkpoint")(path)
    with stdout_to_stderr():
        result = audit(
            Dataset(args.dataset),
            list(stages().values()),
            deep=args.deep,
            fix=args.fix,
            label_problems=hook("label_problems"),
            checkpoints=args.checkpoint,
        )
    seconds = time.perf_counter() - started
    left = sum(not finding.fixed for finding in result.findings)
    if args.json:
        say_json(
            {
                "sound": result.sound,
                "findings": [vars(finding) for finding in result.findings],
                "notes": result.notes,
                "files": result.files,
                "bytes": result.bytes,
                "bytes_read": result.hashed,
                "seconds": round(seconds, 3),
            }
        )
    else:
        for one in result.findings:
            say(f"{one.where}: {one.what}; {'FIXED' if one.fixed else 'fix'}: {one.fix}")
        say(*(f"note: {note}" for note in result.notes))
        count, fixed = len(result.findings), len(result.findings) - left
        verdict = f"{count} findings, {fixed} fixed, {left} left" if count else "sound"
        looked = f"{result.files} files, {result.bytes / 1e6:.1f} MB"
        read = f"{result.hashed / 1e6:.1f} MB read"
        say(f"{args.dataset}: {verdict} ({looked}, {read}, {seconds:.1f} s)")
    return OK if result.sound else FAILED
