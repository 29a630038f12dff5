"""Run ``express50``: one sub-command per stage, and others for datasets, shards and heads."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from express50 import __version__
from express50.cli import dataset, export, plan, stages, status
from express50.console import USAGE, Parser, error_line, log, run_handler
from express50.contract.stage import commands
from express50.errors import Express50Error
from express50.twin import record as twin

OWN = (stages, status, dataset, plan, export, twin)
DESCRIPTION = "From raw multi-view head footage to packed, annotated shards."
EPILOG = """example:
  express50 run DATASET CAPTURE... --budget 2h
exit codes: 0 all done; 1 an item failed or a budget ended; 2 wrong usage or settings, or \
something that a run needs is missing (nothing was started)"""


def build_parser(command: str | None = None) -> argparse.ArgumentParser:
    """Build the parser of all commands.

    A command of another package is loaded only when it is called; otherwise it is just listed.
    """
    parser = Parser(prog="express50", description=DESCRIPTION, epilog=EPILOG)
    parser.add_argument("--version", action="version", version=f"express50 {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for module in OWN:
        module.add_commands(subparsers)
    for name, other in commands().items():
        known = subparsers.choices.get(name)
        if name == command:
            other.add(known or subparsers)
        elif known is None:
            subparsers.add_parser(name, help=other.help)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    command = next((a for a in arguments if not a.startswith("-")), None)
    try:
        args = build_parser(command).parse_args(arguments)
    except SystemExit as stop:  # argparse has said what is wrong
        return stop.code if isinstance(stop.code, int) else USAGE
    except (Express50Error, OSError) as error:  # no dataset, or a broken extension
        log(f"express50: {error_line(error)}")
        return USAGE
    return run_handler("express50", args.handler, args)


if __name__ == "__main__":
    sys.exit(main())
