"""``express50 check`` audits a dataset; ``express50 subject`` withdraws a person from one."""

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
    """Add ``check`` and ``subject withdraw``."""
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
    _add_withdraw(subparsers)


def run_check(args: argparse.Namespace) -> int:
    """Print findings, notes and the amount of data checked."""
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


def _add_withdraw(subparsers: Any) -> None:
    parser = subparsers.add_parser("subject", help="withdraw a person from a dataset")
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    action = actions.add_parser(
        "withdraw",
        help="remove all that the dataset holds of a subject",
        description="Removes a subject's index, derived files, labels, receipts, the packed shards "
        "and whatever of others names the person, takes codes and frames out of checkpoints, notes "
        "in withdrawn.json when that was, then searches all that is left for the subject's id. "
        "Lists only, without --yes. 'express50 check' proves it at any later time.",
        epilog="example: express50 subject withdraw DATASET S001 --yes",
    )
    action.add_argument("dataset", type=Path, metavar="DATASET")
    action.add_argument("subject", metavar="SUBJECT")
    action.add_argument(
        "--checkpoint", type=Path, action="append", default=[], metavar="FILE",
        help="a model outside the dataset that saw the person; may be repeated",
    )  # fmt: skip
    action.add_argument("--yes", action="store_true", help="remove")
    action.add_argument("--json", action="store_true", help="print as JSON")
    action.set_defaults(handler=run_withdraw)


def run_withdraw(args: argparse.Namespace) -> int:
    """Withdraw a subject; the exit code is 1 while a file still names it."""
    from express50.dataset.withdraw import plan, withdraw

    dataset = Dataset(args.dataset)
    for path in args.checkpoint:  # refuses other files before anything is removed
        hook("read_checkpoint")(path)
    if not args.yes:
        paths = [str(path) for path in plan(dataset, args.subject)]
        if args.json:
            say_json({"subject": args.subject, "would_remove": paths})
        else:
            say(*(f"would remove {path}" for path in paths))
            models = [*sorted((dataset.root / "grmm").rglob("*.pt")), *args.checkpoint]
            say(*(f"would take codes and frames out of {path}" for path in models))
            say("add --yes to remove")
        return OK
    done = withdraw(dataset, args.subject, args.checkpoint, hook("redact_checkpoint"))
    account = {
        "subject": done.subject,
        "removed": [str(path) for path in done.removed],
        "files": done.files,
        "checkpoints": [str(path) for path in done.checkpoints],
        "remaining": [str(path) for path in done.remaining],
        "raw_capture": str(done.capture) if done.capture else None,
    }
    if args.json:
        say_json(account)
    else:
        say(*(f"removed {path}" for path in done.removed))
        say(*(f"took codes and frames out of {path}" for path in done.checkpoints))
        say(*(f"STILL NAMES {done.subject}: {path}" for path in done.remaining))
        if done.capture:
            say(f"the raw capture {done.capture} is outside the dataset: delete it yourself")
        say(
            "run 'express50 matte' again, as others' plates may have come from the person, then "
            "the stages after it and 'express50 report'; train models that saw the person again "
            "(their other weights keep an influence), and delete exports outside the dataset"
        )
    return FAILED if done.remaining else OK
