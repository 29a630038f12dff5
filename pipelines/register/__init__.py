"""The register stage lays each expression's tracked mesh onto the reconstructed surface."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

from express50.capture.index import tracked_items
from express50.contract.layout import Dataset
from express50.contract.stage import Command, Growth, NoSettings, Result, Stage
from express50.errors import ConfigError, advised
from express50.head import BUILTIN_NAME


def inputs(dataset: Dataset, item: str, config: NoSettings) -> dict[str, Path | str]:
    """Name the cameras, the track and the expression's surface."""
    from express50.dataset.tracks import track_inputs

    subject, expression = item.split("/")
    return {
        "cameras": dataset.cameras_file(subject),
        **track_inputs(dataset, subject),
        "surface": dataset.surface_file(subject, expression),
    }


def run(dataset: Dataset, item: str, config: NoSettings, out: Path) -> Result:
    """Register one expression."""
    from pipelines.register.stage import run as work

    return work(dataset, item, out)


STAGE = Stage(
    name="register",
    version=10,
    config=NoSettings,
    items=tracked_items,
    inputs=inputs,
    run=run,
    help="lay the tracked mesh onto the reconstructed surface",
    purpose="Each vertex moves along its normal to the surface, except under hair, at lips, eyes"
    " and nostrils, and where no view shows skin. Every vertex gets a residual, a standard"
    " deviation and an error bound.",
    growth=Growth(items=("subjects", "expressions")),
)


def add_options(parser: Any) -> None:
    """Add the options of ``express50 register`` that make it register scans."""
    parser.add_argument(
        "--scan", type=Path, action="append", metavar="FILE",
        help="register this scan (.obj, .ply, .glb, .stl), or all scans of this folder, with the"
        " landmark files beside them; DATASET is then the folder to write to; may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--head", default=BUILTIN_NAME, metavar="MODEL",
        help="with --scan: head model to fit, as in track.head (default: %(default)s)",
    )  # fmt: skip
    parser.set_defaults(handler=run_command)


def run_command(args: Any) -> int:
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
