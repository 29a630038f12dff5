"""``express50 subject``: withdraw a person from a dataset."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from express50.console import FAILED, OK, say, say_json
from express50.contract.extensions import hook
from express50.contract.layout import Dataset


def add_commands(subparsers: Any) -> None:
    """Add the ``subject`` command."""
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
    """Withdraw; exit code 1 when a file that names the subject is left."""
    from express50.dataset.withdraw import plan, withdraw

    dataset = Dataset(args.dataset)
    for path in args.checkpoint:  # says what is no model of ours, before anything is removed
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
