"""``grmm render``, ``grmm export`` and ``grmm view``."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from express50.console import OK, say
from express50.errors import ConfigError
from grmm.cli.shared import (
    add_edit,
    at_least,
    edited_head,
    frame_head,
    load,
    no_file,
)

if TYPE_CHECKING:
    import numpy as np

    from express50.dataset.tracks import Sequence
    from grmm.checkpoint import Loaded
    from grmm.edit import HeadCodes
    from grmm.scene import PinholeView


def add_render(commands: argparse._SubParsersAction) -> None:
    """Add the parser of ``grmm render``."""
    parser = commands.add_parser(
        "render",
        help="draw a head, edited as asked: pictures, sheets, videos",
        epilog="example: grmm render run/checkpoint.pt pictures --subject S002 "
        "--expression-of S001/smile --control jaw.0=0.2 --turntable --views",
    )
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("out", type=Path, help="folder for pictures and videos")
    add_edit(parser)
    parser.add_argument("--yaw", type=float, default=0.0, help="degrees the camera goes round")
    parser.add_argument("--pitch", type=float, default=0.0, help="degrees the camera goes up")
    parser.add_argument("--turntable", action="store_true", help="turntable.mp4")
    parser.add_argument("--degrees", type=float, default=360.0, help="how far the turntable goes")
    parser.add_argument("--frames", type=at_least(1), default=72, help="frames of a video")
    parser.add_argument("--to", metavar="SUBJECT/EXPRESSION", help="interpolation.mp4 ending there")
    parser.add_argument(
        "--drive", type=Path, metavar="SEQUENCE.NPZ", help="driven.mp4: moved as tracked clips are"
    )
    parser.add_argument("--drive-cue", metavar="ID", help="only this clip of --drive")
    parser.add_argument("--views", action="store_true", help="views.jpg: novel views")
    parser.add_argument("--controls", action="store_true", help="controls.jpg: one thing at a time")
    parser.add_argument(
        "--samples", type=at_least(0), default=0, help="samples.jpg: new heads, this many"
    )
    parser.add_argument("--spread", type=float, default=1.0, help="of samples, 1 = as trained")
    parser.add_argument("--seed", type=int, default=0, help="of samples")
    parser.add_argument("--columns", type=at_least(1), default=8, help="expressions in grid.jpg")
    parser.set_defaults(handler=_render)


def _render(args: argparse.Namespace) -> int:
    from express50.files.images import write_image
    from grmm import render

    no_file(args.out)
    loaded = load(args.checkpoint)
    head = edited_head(loaded, args)
    own = render.camera_of(loaded, args.camera, args.size)
    view = render.orbit(own, args.yaw, loaded.model.head_centre, args.pitch)
    args.out.mkdir(parents=True, exist_ok=True)
    write_image(args.out / "picture.png", render.picture(loaded, head, view))
    say(f"wrote {args.out / 'picture.png'}")
    if args.turntable:
        frames = render.turntable(loaded, head, view, args.frames, args.degrees)
        _video(args.out / "turntable.mp4", frames)
    if args.to:
        end = frame_head(loaded, args.to, args.expression)
        _video(
            args.out / "interpolation.mp4",
            render.interpolation(loaded, head, end, view, args.frames),
        )
    if args.drive:
        frames = render.driven(loaded, head, _clips(args.drive, args.drive_cue), view)
        _video(args.out / "driven.mp4", frames)
    if args.views:
        _sheet(args.out / "views.jpg", render.novel_views(loaded, head, view))
    _sheets(loaded, head, view, args)
    expressions = loaded.model.expressions[: args.columns]
    subjects = loaded.model.subjects[:8]
    _sheet(args.out / "grid.jpg", render.expression_grid(loaded, subjects, expressions, view))
    return OK


def _clips(path: Path, cue: str | None) -> Sequence:
    from express50.dataset.tracks import OF_FRAMES, read_sequence

    clips = read_sequence(path)
    if cue is None:
        return clips
    rows = [i for i, name in enumerate(clips.cues) if name == cue]
    if not rows:
        known = ", ".join(dict.fromkeys(clips.cues))
        raise ConfigError(f"--drive-cue {cue}: {path} has no such clip; expected one of {known}")
    parts = {name: getattr(clips, name)[rows] for name in OF_FRAMES}
    return replace(clips, cues=(cue,) * len(rows), **parts)


def _sheets(loaded: Loaded, head: HeadCodes, view: PinholeView, args: argparse.Namespace) -> None:
    from grmm import render

    if args.controls:
        _sheet(args.out / "controls.jpg", *render.control_sheet(loaded, head, view))
    if args.expression_of:
        plain = frame_head(loaded, args.subject or loaded.model.subjects[0])
        donor = frame_head(loaded, args.expression_of)
        _sheet(args.out / "transfer.jpg", *render.residual_sheet(loaded, plain, donor, view))
    if args.samples:
        sheet, _ = render.sample_sheet(loaded, head, view, args.samples, args.seed, args.spread)
        _sheet(args.out / "samples.jpg", *sheet)


def _sheet(path: Path, rows: list[list[np.ndarray]], labels: list[str] | None = None) -> None:
    from grmm.render import write_sheet

    write_sheet(path, rows, labels)
    say(f"wrote {path}")


def _video(path: Path, frames: Iterable[np.ndarray]) -> None:
    from grmm.render import write_video

    write_video(path, frames)
    say(f"wrote {path}")


def add_export(commands: argparse._SubParsersAction) -> None:
    """Add the parser of ``grmm export``."""
    parser = commands.add_parser(
        "export",
        help="write a head as .ply, .glb or .npz",
        epilog="example: grmm export run/checkpoint.pt head.glb --expression smile",
    )
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument(
        "out", type=Path, help=".ply: splats; .glb: textured mesh; .npz: all arrays, codes too"
    )
    add_edit(parser)
    parser.add_argument("--points", action="store_true", help=".glb of the Gaussians' centres")
    parser.set_defaults(handler=_export)


def _export(args: argparse.Namespace) -> int:
    from grmm.export import write_export
    from grmm.render import camera_of

    loaded = load(args.checkpoint)
    head, view = edited_head(loaded, args), camera_of(loaded, args.camera, args.size)
    say(f"wrote {args.out}: {write_export(args.out, loaded, head, view, args.points)}")
    return OK


def add_view(commands: argparse._SubParsersAction) -> None:
    """Add the parser of ``grmm view``."""
    parser = commands.add_parser(
        "view",
        help="turn, move and blend a head in the browser",
        epilog="example: grmm view run/checkpoint.pt",
    )
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (this machine)")
    parser.add_argument("--port", type=at_least(1, 65535), default=8080)
    parser.add_argument(
        "--size", type=at_least(16), default=320, help="height while things move, pixels"
    )
    parser.add_argument(
        "--still", type=at_least(16), default=512, help="height once they rest, pixels"
    )
    parser.set_defaults(handler=_view)


def _view(args: argparse.Namespace) -> int:
    from grmm.viewer import Viewer

    viewer = Viewer(load(args.checkpoint), args.host, args.port, args.size, args.still)
    if viewer.port != args.port:
        say(f"port {args.port} is taken; this is another")
    say(f"http://{args.host}:{viewer.port}  (Ctrl-C stops)")
    viewer.run()
    return OK
