"""``express50 cameras`` imports another tool's calibration, and checks any rig.

The list of commands imports this file, so the readers of rigs are imported when they are needed.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from express50.console import (
    FAILED,
    OK,
    add_command,
    count,
    log,
    number,
    picture_size,
    say,
    say_json,
)
from express50.contract.layout import check_results_file
from express50.contract.stage import Command
from express50.errors import CalibrationError, ConfigError

if TYPE_CHECKING:
    from express50.geometry.cameras import Camera
    from express50.rigs.world_frame import RigVerdict
    from pipelines.calibrate.given_rig import FootageCheck


def add_commands(subparsers: Any) -> None:
    """Add ``cameras import`` and ``cameras check``."""
    from express50.rigs.read import FORMATS

    parser = subparsers.add_parser("cameras", help="import and check calibrations")
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    importing = add_command(
        actions, "import", run_import, "write another tool's calibration as calibration.json",
        dataset=False,
        example="express50 cameras import sparse/0 capture/calibration.json --scale 0.42",
    )  # fmt: skip
    words = "file or folder of the other tool"
    importing.add_argument("source", type=Path, metavar="SOURCE", help=words)
    importing.add_argument("out", type=Path, metavar="OUT", help="calibration.json to write")
    words = "replace the cameras that OUT holds"
    importing.add_argument("--overwrite", action="store_true", help=words)
    words = "check whether a rig's cameras fit together"
    checking = add_command(actions, "check", run_check, words, dataset=False)
    words = "calibration in any known format"
    checking.add_argument("source", type=Path, metavar="SOURCE", help=words)
    words = "also look for cameras that have moved since"
    checking.add_argument("--footage", type=Path, metavar="CAPTURE", help=words)
    words = "with --footage: number of frame sets to compare (default: 4)"
    checking.add_argument("--frames", type=number(1), default=4, metavar="N", help=words)
    for action in (importing, checking):
        add = action.add_argument
        words = f"format of SOURCE: {', '.join(FORMATS)} (default: recognised)"
        add("--format", choices=FORMATS, metavar="NAME", help=words)
        words = "size of the footage, pixels, to which K is scaled (default: as in SOURCE)"
        add("--size", type=picture_size, metavar="WIDTHxHEIGHT", help=words)
        words = "metres per unit of SOURCE's world (default: 1)"
        add("--scale", type=number(1e-9, kind=float), default=1.0, metavar="METRES", help=words)


def run_import(args: argparse.Namespace) -> int:
    """Write the cameras and say what was found; exit code 1 when they do not fit together."""
    from express50.files.calibration import camera_rows, read_cameras, write_cameras

    cameras, verdict = _read(args)
    if args.out.is_dir():
        raise ConfigError(f"{args.out} is a folder, expected a file such as calibration.json")
    check_results_file(args.out)
    if args.out.exists() and args.out.samefile(args.source):
        raise ConfigError(
            f"{args.out} is both SOURCE and OUT, and a second import would scale it again; write"
            " to another file"
        )
    if args.out.exists() and args.out.suffix != ".json":
        raise ConfigError(f"{args.out} exists and is not a .json file; write to another file")
    if args.out.exists() and not args.overwrite:
        try:
            same = camera_rows(read_cameras(args.out)) == camera_rows(cameras)
        except CalibrationError:
            same = False
        if not same:
            raise ConfigError(
                f"{args.out} holds other cameras; write to another file, or add --overwrite"
            )
    if not verdict.problem:
        write_cameras(args.out, cameras)
    _report(args, cameras, verdict, None if verdict.problem else args.out)
    return FAILED if verdict.problem else OK


def run_check(args: argparse.Namespace) -> int:
    """Say what was found; exit code 1 if the cameras fit neither together nor their footage."""
    cameras, verdict = _read(args)
    footage = None
    if args.footage is not None and not verdict.problem:
        # Imported here: the other commands need neither torch nor OpenCV's features.
        from pipelines.calibrate.footage import find_points, read_raw_footage
        from pipelines.calibrate.given_rig import check_footage

        log(f"{args.footage}: looking for points in {count(len(cameras), 'camera')}")
        seen = find_points(partial(read_raw_footage, args.footage, cameras, args.frames))
        shown = {name for points in seen.values() for name in points.features}
        footage = check_footage({n: c for n, c in cameras.items() if n in shown}, seen)
    _report(args, cameras, verdict, None, footage)
    return FAILED if verdict.problem or (footage and footage.moved) else OK


def _read(args: argparse.Namespace) -> tuple[dict[str, Camera], RigVerdict]:
    from express50.rigs.read import read_rig
    from express50.rigs.world_frame import judge

    cameras = read_rig(args.source, args.format, args.size, args.scale)
    return cameras, judge(cameras)


def _report(
    args: argparse.Namespace,
    cameras: Mapping[str, Camera],
    verdict: RigVerdict,
    out: Path | None,
    footage: FootageCheck | None = None,
) -> None:
    from express50.rigs.read import guess_format

    kind = args.format or guess_format(args.source)
    if args.json:
        seen = {}
        if footage:
            row = asdict(footage)
            del row["cameras"]
            seen = {"footage": row}
        say_json({"format": kind, "out": out and str(out), **asdict(verdict), **seen})
        return
    say(f"{args.source}: {verdict.cameras} cameras ({kind})")
    say(f"{'camera':16} {'size':>11} {'model':14} {'focal px':>9} {'view deg':>9}")
    for name, camera in cameras.items():
        fx = camera.K[0, 0]
        view = 2 * math.degrees(math.atan(camera.width / (2 * fx)))
        size = f"{camera.width}x{camera.height}"
        say(f"{name:16} {size:>11} {camera.model:14} {fx:9.1f} {view:9.1f}")
    if verdict.meeting is not None:
        place = ", ".join(f"{round(x, 3) + 0.0:.3f}" for x in verdict.meeting)  # no "-0.000"
        say(f"they look at ({place}) m from {verdict.distance_m:.3f} m;"
            f" axes miss it by {verdict.miss_mm:.0f} mm (median)")  # fmt: skip
    say(*(f"warning: {warning}" for warning in verdict.warnings))
    if verdict.problem:
        say(f"wrong: {verdict.problem}")
        say(
            "remedy: "
            + (verdict.remedy or "not known: no common misreading of conventions explains it")
        )
    elif out is not None:
        say(f"wrote {out}")
    if footage is None:
        return
    error = "" if footage.error_px is None else f", off by {footage.error_px:.2f} px (median)"
    say(f"footage: {footage.points} points{error}")
    for name, why in footage.unchecked.items():
        say(f"warning: {name} cannot be checked: {why}")
    for name, why in footage.mirrored.items():
        say(f"mirrored: {name}: {why}")
    for name in sorted(set(footage.moved) - set(footage.mirrored)):
        move = footage.moved[name]
        say(
            f"moved: {name}: its picture is {move.shift_px:.1f} px off, as if turned by"
            f" {move.turn_deg:.2f} deg and shifted by {move.move_mm:.1f} mm; calibrate it again"
        )


COMMAND = Command("import and check calibrations", add_commands)
