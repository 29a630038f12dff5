"""Run the commands that show heads: ``export`` for other tools, ``report``, ``head preview``."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from express50.console import OK, add_command, answer, count, number, say, say_json
from express50.contract.layout import check_results_file, check_results_folder, existing_dataset
from express50.errors import ConfigError, StageError, advised
from express50.head import BUILTIN_NAME

FORMATS = ("gaussian-avatars", "obj", "ply", "glb")


def add_commands(subparsers: Any) -> None:
    """Add ``export``, ``report`` and ``head preview``."""
    parser = add_command(
        subparsers, "export", run_export, "write tracked heads for other tools",
        description="Write tracked heads as a GaussianAvatars dataset or as meshes.",
        example="express50 export data/mine out --format gaussian-avatars --subject S001\n"
        "writes OUT/<subject>/; an earlier export of the subject is replaced",
    )  # fmt: skip
    add = parser.add_argument
    add("out", type=Path, metavar="OUT", help="folder to write to, one folder per subject")
    words = "what to write: a data set for GaussianAvatars, or meshes"
    add("--format", required=True, choices=FORMATS, help=words)
    for name in ("subject", "expression"):
        words = f"only this {name}; may be repeated (default: all)"
        add(f"--{name}", action="append", default=[], metavar="ID", help=words)
    words = "a mesh per peak, or per tracked frame (which needs track.frames=clips, or a video)"
    words += " (default: peaks)"
    add("--frames", choices=("peaks", "clips"), default="peaks", help=words)
    add = parser.add_argument_group("with --format gaussian-avatars").add_argument
    words = "background of the pictures (default: alpha, which stores the opacity)"
    add("--background", choices=("alpha", "white", "black"), default="alpha", help=words)
    words = "write masks without the torso, from the regions stage"
    add("--head-only", action="store_true", help=words)
    words = "make width and height of pictures N times smaller (default: 1)"
    add("--downscale", type=number(1), default=1, metavar="N", help=words)
    words = "divide out the cameras' colour gains that calibrate measured on a board"
    add("--even-colour", action="store_true", help=words)
    words = "expression to hold out for testing; may be repeated (default: the last three tenths)"
    add("--test-expression", action="append", metavar="ID", help=words)
    words = "camera to hold out for validation (default: the last)"
    add("--validation-camera", metavar="ID", help=words)

    words = "write one self-contained HTML page of results and pictures"
    parser = add_command(subparsers, "report", run_report, words)
    words = "folder of the page (default: DATASET/report)"
    parser.add_argument("--out", type=Path, metavar="FOLDER", help=words)
    parser.add_argument(
        "--title", metavar="TEXT", help="heading of the page (default: the dataset's name)"
    )

    area = subparsers.add_parser("head", help="draw a head model")
    actions = area.add_subparsers(dest="action", metavar="ACTION", required=True)
    words = "draw a head model in typical poses"
    parser = add_command(
        actions, "preview", run_preview, words, dataset=False, json=False,
        example="express50 head preview build/head.png --yaws 0,40,90\n"
        "the picture has a row per pose that the model can take, and a column per yaw",
    )  # fmt: skip
    add = parser.add_argument
    add("out", type=Path, metavar="OUT", help="picture to write (.png or .jpg)")
    words = f"{BUILTIN_NAME}, or the path of a FLAME, ICT-FaceKit or .npz model"
    words += " (default: %(default)s)"
    add("--model", default=BUILTIN_NAME, help=words)
    words = "directions to look from, degrees to the subject's left (default: 0,40,90)"
    add("--yaws", default="0,40,90", metavar="DEG,...", help=words)
    words = "side of a picture, pixels (default: 256)"
    add("--size", type=number(1), default=256, metavar="N", help=words)


def run_export(args: argparse.Namespace) -> int:
    """Export the chosen subjects, one after the other."""
    from express50.dataset.export import (
        export_meshes,
        exporting,
        read_tracked,
        tracked_subjects,
        with_clips,
        with_registered,
    )
    from express50.dataset.export_avatar import AvatarOptions, export_avatar

    if args.frames == "clips" and args.format == "gaussian-avatars":
        raise ConfigError(
            "--frames clips: gaussian-avatars needs a matte of every frame, but 'matte' only makes"
            " those of peaks; export the clips as obj, ply or glb"
        )
    held = args.test_expression
    options = AvatarOptions(
        background=args.background, head_only=args.head_only, downscale=args.downscale,
        even_colour=args.even_colour, validation_camera=args.validation_camera,
        test_expressions=None if held is None else tuple(held),
    )  # fmt: skip
    if args.format != "gaussian-avatars" and options != AvatarOptions():
        raise ConfigError(
            f"--format {args.format}: --background, --head-only, --downscale, --even-colour,"
            " --test-expression and --validation-camera are for gaussian-avatars; leave them out"
        )
    check_results_folder(args.out)
    dataset, accounts = existing_dataset(args.dataset), []
    for subject in tracked_subjects(dataset, args.subject):
        head = read_tracked(dataset, subject, args.expression)
        if args.frames == "clips":
            head = with_clips(dataset, head, args.expression)
        elif args.format != "gaussian-avatars":  # it holds parameters and the meshes they pose
            head = with_registered(dataset, head)
        with exporting(args.out, subject) as folder:
            if args.format == "gaussian-avatars":
                meta = export_avatar(dataset, head, options, folder)
            else:
                meta = export_meshes(head, args.format, folder)
        what = {"of": "frame" if args.frames == "clips" else "expression"}
        accounts.append({"folder": str(args.out / subject), **what, **meta})
        if not args.json:
            say(*_lines(accounts[-1]))
    if args.json:
        say_json(accounts)
    return OK


def _lines(account: dict) -> list[str]:
    words = f"{account['folder']}: {count(len(account['expressions']), account['of'])}"
    if "views" in account:
        words += f", {account['views']} of {count(account['read'], 'view')}"
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
    """Write DATASET/report/index.html from the stages' outputs."""
    from express50.dataset.report import render_page
    from express50.files.atomic import write_bytes

    dataset = existing_dataset(args.dataset)
    if not dataset.subjects():
        ingest = advised("express50 ingest", args.dataset, "CAPTURE")
        raise StageError(f"{args.dataset}: nothing is ingested; run {ingest} first")
    path = (args.out or dataset.report_dir) / "index.html"
    check_results_file(path)
    ours = b":root { --ink:#1d2126;"  # how the style sheet of our pages begins
    if args.out and path.exists() and ours not in path.read_bytes():
        raise ConfigError(f"{path}: is another page; name another folder")
    page = render_page(dataset, args.title).encode()
    write_bytes(path, page)
    data = {"report": str(path), "bytes": len(page)}
    return answer(args, data, f"{path} ({len(page):,} bytes)")


def run_preview(args: argparse.Namespace) -> int:
    """Write a contact sheet of a head model."""
    from express50.files.images import check_ending, write_image
    from express50.head.load import load_head
    from express50.head.preview import pose_sheet

    try:
        yaws = tuple(float(part) for part in args.yaws.split(","))
    except ValueError:
        yaws = (math.nan,)
    if not all(map(math.isfinite, yaws)):
        raise ConfigError(f"--yaws {args.yaws!r}: expected numbers with commas, such as 0,40,90")
    check_ending(args.out)
    check_results_file(args.out)
    model = load_head(args.model)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_image(args.out, pose_sheet(model, yaws, args.size))
    say(f"wrote {args.out}: {model.name}, {len(model.template)} vertices")
    return OK
