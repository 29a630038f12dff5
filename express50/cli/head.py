"""``express50 head preview``: a contact sheet of a head model in typical poses."""

from __future__ import annotations

import argparse
from pathlib import Path

_EPILOG = """example:
  express50 head preview build/head.png --yaws 0,40,90
one row a pose (those that the model has the controls for), one column a yaw in degrees"""


def add_commands(subparsers: argparse._SubParsersAction) -> None:
    """Add ``head`` with its sub-command ``preview``."""
    area = subparsers.add_parser("head", help="look at a head model")
    actions = area.add_subparsers(dest="action", metavar="ACTION", required=True)
    parser = actions.add_parser(
        "preview",
        help="draw a head model in typical poses",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("out", type=Path, metavar="OUT", help="picture to write (.png or .jpg)")
    parser.add_argument(
        "--model", default="procedural", help="head model, as load_head takes it [procedural]"
    )
    parser.add_argument(
        "--yaws", type=_angles, default=(0.0, 40.0, 90.0), metavar="DEG,...",
        help="sides to look from, degrees to the subject's left [0,40,90]",
    )  # fmt: skip
    parser.add_argument("--size", type=int, default=256, help="side of a picture, pixels [256]")
    parser.set_defaults(handler=_preview)


def _angles(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"got {text!r}, expected numbers with commas, such as 0,40,90"
        ) from error


def _preview(args: argparse.Namespace) -> int:
    from express50.files.images import write_image
    from express50.head.load import load_head
    from express50.head.preview import contact_sheet

    model = load_head(args.model)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_image(args.out, contact_sheet(model, args.yaws, args.size))
    print(f"wrote {args.out}: {model.name}, {len(model.template)} vertices")
    return 0
