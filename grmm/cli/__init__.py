"""``grmm``: train, fit, config, render, export, view, evaluate, score, ablate, study.

Handlers parse, call the library, print.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from express50 import __version__
from express50.console import run_handler
from grmm.cli import draw, learn, measure
from grmm.study import add_study

DESCRIPTION = "Train the Gaussian Residual Morphable Model on packed shards, and use it."
EPILOG = """example:
  grmm train DATASET/pack/shards OUT --preset measured --budget 10m
exit codes: 0 done, 1 failed, 2 wrong usage or configuration"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the ``grmm`` command; returns the exit code (0 ok, 1 failed, 2 usage)."""
    args = build_parser().parse_args(arguments)
    return run_handler("grmm", args.handler, args)


def build_parser() -> argparse.ArgumentParser:
    """Build the argument parser with all commands."""
    parser = argparse.ArgumentParser(
        prog="grmm",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"grmm {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    learn.add_train(commands)
    learn.add_fit(commands)
    learn.add_config(commands)
    draw.add_render(commands)
    draw.add_export(commands)
    draw.add_view(commands)
    measure.add_evaluate(commands)
    measure.add_score(commands)
    measure.add_ablate(commands)
    add_study(commands)
    return parser
