"""The ``express50`` command: one sub-command a stage, and those of the other areas.

Only the module of the command that was asked for is imported.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module

from express50 import __version__
from express50.cli.stages import add_dataset_commands, add_stage_commands
from express50.console import USAGE, run_handler

# Commands of other areas: the module has add_commands(subparsers) for the command named here.
AREAS = {
    "twin": ("express50.twin.cli", "record a synthetic capture with known truth"),
    "annotate": ("annotations.cli", "label peak frames, review and export labels"),
    "shards": ("express50.cli.shards", "look into packed shards and verify them"),
    "cameras": ("pipelines.calibrate.cli", "import and check calibrations"),
    "head": ("express50.cli.head", "look at a head model"),
    "photo": ("pipelines.photo.cli", "track the face of a bare photograph or video"),
    "check": ("express50.cli.check", "audit a dataset against its ledger, and mend it"),
    "plan": ("express50.cli.plan", "what a campaign costs, from a measured dataset's receipts"),
    "subject": ("express50.cli.subject", "withdraw a person from a dataset"),
    "export": ("express50.cli.export", "write tracked heads for other tools"),
    "report": ("express50.cli.report", "gather QC figures into one HTML page"),
}
DESCRIPTION = "From raw multi-view head footage to packed, annotated shards."
EPILOG = """example:
  express50 run DATASET CAPTURE... --preset draft
exit codes: 0 all done, 1 some item failed, 2 wrong usage or configuration"""


def build_parser(command: str | None = None) -> argparse.ArgumentParser:
    """Parser of all commands; the areas' own options are there only for the given command."""
    parser = argparse.ArgumentParser(
        prog="express50",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"express50 {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    add_stage_commands(subparsers)
    add_dataset_commands(subparsers)
    for name, (module, words) in AREAS.items():
        if name == command:
            import_module(module).add_commands(subparsers)
        else:
            subparsers.add_parser(name, help=words)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    command = next((a for a in arguments if not a.startswith("-")), None)
    try:
        args = build_parser(command).parse_args(arguments)
    except SystemExit as stop:  # argparse has said what is wrong
        return stop.code if isinstance(stop.code, int) else USAGE
    return run_handler("express50", args.handler, args)
