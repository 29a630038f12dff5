"""Add the options of ``express50 register`` that make it register scans."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

from express50.contract.stage import Command
from express50.errors import ConfigError, advised
from express50.head import BUILTIN_NAME


def add_options(parser: Any) -> None:
    """Add the options to the parser of the stage's command."""
    parser.add_argument(
        "--scan", type=Path, action="append", metavar="FILE",
        help="register this scan (.obj, .ply, .glb, .stl), or all scans of this folder, with the"
        " landmark files beside them; DATASET is then the folder to write to; may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--head", default=BUILTIN_NAME, metavar="MODEL",
        help="with --scan: head model to fit, as in track.head (default: %(default)s)",
    )  # fmt: skip
    parser.set_defaults(handler=run)


def run(args: Any) -> int:
    """Register scans if any are given, else a dataset's expressions."""
    if args.scan:
        from pipelines.register.scan_files import run_scans

        return run_scans(args)
    if args.head != BUILTIN_NAME:
        track = advised("express50 track", args.dataset)
        raise ConfigError(
            f"--head {args.head} is for scans; a dataset's head model is track.head, so run"
            f" {track} with --set {shlex.quote(f'track.head={args.head}')}"
        )
    from express50.cli.stages import run_one

    return run_one(args)


COMMAND = Command("register scans", add_options)
