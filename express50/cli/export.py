"""``express50 export`` writes tracked heads for other tools; ``express50 report`` one HTML page."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from express50.console import OK, say, say_json
from express50.contract.layout import Dataset
from express50.errors import ConfigError, StageError

FORMATS = ("gaussian-avatars", "obj", "ply", "glb")
_EPILOG = """example:
  express50 export data/mine out --format gaussian-avatars --subject S001
writes OUT/<subject>/, replacing a former export of the subject whole"""


def add_commands(subparsers: Any) -> None:
    """Add ``export`` and ``report``."""
    parser = subparsers.add_parser(
        "export",
        help="write tracked heads for other tools",
        description="Writes tracked heads as a GaussianAvatars data set or as meshes.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("dataset", type=Path, metavar="DATASET")
    parser.add_argument("out", type=Path, metavar="OUT", help="folder that gets one per subject")
    parser.add_argument("--format", required=True, choices=FORMATS, help="what to write")
    for name in ("subject", "expression"):
        parser.add_argument(
            f"--{name}", action="append", default=[], metavar="ID", help=f"only this {name};"
            " may be repeated",
        )  # fmt: skip
    parser.add_argument(
        "--frames", choices=("peaks", "clips"), default="peaks",
        help="clips: a mesh of every tracked frame (track.frames=clips, or a video's) [peaks]",
    )  # fmt: skip
    group = parser.add_argument_group("of gaussian-avatars")
    group.add_argument(
        "--background", choices=("alpha", "white", "black"), default="alpha",
        help="what is behind the head in the pictures [alpha: they keep their opacity]",
    )  # fmt: skip
    group.add_argument(
        "--head-only", action="store_true", help="masks without the torso, by the regions stage"
    )
    group.add_argument(
        "--downscale", type=int, default=1, metavar="N", help="pictures N times smaller [1]"
    )
    group.add_argument(
        "--even-colour", action="store_true",
        help="divide the cameras' colour gains, measured by calibrate, out of the pictures",
    )  # fmt: skip
    group.add_argument(
        "--test-expression", action="append", metavar="ID",
        help="held back for testing; may be repeated [the last three tenths]",
    )  # fmt: skip
    group.add_argument("--validation-camera", metavar="ID", help="held back in training [the last]")
    parser.add_argument("--json", action="store_true", help="print the account as JSON")
    parser.set_defaults(handler=run_export)
    parser = subparsers.add_parser(
        "report", help="gather QC into one self-contained HTML page", description=run_report.__doc__
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--out", type=Path, help="folder of the page (default: DATASET/report)")
    parser.add_argument("--title", help="heading of the page")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(handler=run_report)


def run_export(args: argparse.Namespace) -> int:
    """Export the chosen subjects, one after the other."""
    from express50.dataset.export.select import (
        exporting,
        read_tracked,
        tracked_subjects,
        with_clips,
    )

    if args.frames == "clips" and args.format == "gaussian-avatars":
        raise ConfigError(
            "--frames clips: gaussian-avatars needs a matte of every frame, and 'matte' makes those"
            " of peaks alone; export the clips as obj, ply or glb"
        )

    dataset, accounts = Dataset(args.dataset), []
    for subject in tracked_subjects(dataset, args.subject):
        head = read_tracked(dataset, subject, args.expression)
        head = with_clips(dataset, head, args.expression) if args.frames == "clips" else head
        with exporting(args.out, subject) as folder:
            meta = _write(dataset, head, args, folder)
        what = {"of": "frames"} if args.frames == "clips" else {}
        accounts.append({"folder": str(args.out / subject), **what, **meta})
        if not args.json:
            say(*_lines(accounts[-1]))
    if args.json:
        say_json(accounts)
    return OK


def _write(dataset: Any, head: Any, args: argparse.Namespace, folder: Path) -> dict:
    if args.format != "gaussian-avatars":
        from express50.dataset.export.meshes import export_meshes

        return export_meshes(head, args.format, folder)
    from express50.dataset.export.gaussian_avatars import AvatarOptions, export_avatar

    held = None if args.test_expression is None else tuple(args.test_expression)
    options = AvatarOptions(
        background=args.background,
        head_only=args.head_only,
        downscale=args.downscale,
        even_colour=args.even_colour,
        test_expressions=held,
        validation_camera=args.validation_camera,
    )
    return export_avatar(dataset, head, options, folder)


def _lines(account: dict) -> list[str]:
    words = f"{account['folder']}: {len(account['expressions'])} {account.get('of', 'expressions')}"
    if "views" in account:
        words += f", {account['views']} of {account['read']} views"
    lines = [words]
    lines += [f"left out {row['what']}: {row['why']}" for row in account.get("dropped", [])]
    if account.get("cameras_centred"):
        lines.append(
            f"pictures centred on the optical axis: {', '.join(account['cameras_centred'])}"
        )
    if account["format"] == "gaussian-avatars" and account["coefficients"] != "FLAME":
        lines.append(f"head model {account['head']} is not FLAME: use the meshes, see export.json")
    return lines


def run_report(args: argparse.Namespace) -> int:
    """Write DATASET/report/index.html from what the stages left behind."""
    from express50.dataset.report.page import render_page
    from express50.files.atomic import write_bytes

    dataset = Dataset(args.dataset)
    if not dataset.subjects():
        raise StageError(f"{args.dataset}: nothing is ingested; run 'express50 ingest' first")
    path = (args.out or dataset.report_dir) / "index.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, render_page(dataset, args.title).encode())
    size = path.stat().st_size
    say(
        json.dumps({"report": str(path), "bytes": size})
        if args.json
        else f"{path} ({size:,} bytes)"
    )
    return OK
