"""``express50 twin record``: make synthetic captures with known truth."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

from express50.contract.config import field_documents
from express50.twin.config import TwinConfig

_EPILOG = """example:
  express50 twin record build/twin --subjects 4 --cameras 8 --width 320 --height 320 \\
      --expressions neutral,smile,jaw_open --frames-per-expression 8 --seed 0
writes build/twin/captures/S001... (for 'express50 ingest') and build/twin/truth/S001..."""
_NUMBERS = (
    "subjects", "first_subject", "cameras", "width", "height", "frames_per_expression", "fps",
    "seed", "crf", "board_frames", "noise",
)  # fmt: skip


def add_commands(subparsers: argparse._SubParsersAction) -> None:
    """Add ``twin`` with its sub-command ``record``."""
    area = subparsers.add_parser("twin", help="record a synthetic capture with known truth")
    actions = area.add_subparsers(dest="action", metavar="ACTION", required=True)
    parser = actions.add_parser(
        "record",
        help="record subjects of the digital twin",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    words, default = field_documents(TwinConfig), TwinConfig()
    parser.add_argument("out", type=Path, metavar="OUT", help="folder for captures/ and truth/")
    for name in _NUMBERS:
        value = getattr(default, name)
        parser.add_argument(
            f"--{name.replace('_', '-')}", type=type(value), default=value, metavar="N",
            help=f"{words[name]} [{value}]",
        )  # fmt: skip
    parser.add_argument("--head", default=default.head, help=words["head"] + f" [{default.head}]")
    parser.add_argument("--expressions", metavar="ID,ID...", help=words["expressions"])
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--video", action="store_true", help="write H.264 videos [default]")
    kind.add_argument("--frames", choices=("png", "jpg"), nargs="?", const="png",
                      help="write single images instead of videos")  # fmt: skip
    parser.add_argument("--give-calibration", action="store_true", help=words["give_calibration"])
    parser.add_argument("--no-plates", action="store_true", help="leave clean plates out")
    parser.add_argument("--no-hair", action="store_true", help="bald subjects")
    parser.add_argument("--workers", type=int, default=min(8, os.cpu_count() or 1), metavar="N",
                        help="processes; they do not change the bytes")  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.set_defaults(handler=record_command)


def record_command(args: argparse.Namespace) -> int:
    """Record and say what was recorded."""
    from express50.twin.record import print_progress, record

    config = config_from(args)
    recorded = record(config, args.out, max(1, args.workers), print_progress())
    if args.json:
        print(json.dumps({"captures": str(args.out / "captures"), "recorded": recorded}))
    else:
        print(f"{len(recorded)} subjects recorded in {args.out / 'captures'}; the rest was there")
    return 0


def config_from(args: argparse.Namespace) -> TwinConfig:
    """Return the configuration that the command line asks for."""
    ids = None
    if args.expressions:
        ids = tuple(part.strip() for part in args.expressions.split(",") if part.strip())
    return TwinConfig(
        **{name: getattr(args, name) for name in _NUMBERS},
        head=args.head,
        expressions=ids,
        footage=args.frames or "video",
        give_calibration=args.give_calibration,
        plates=not args.no_plates,
        hair=not args.no_hair,
    )
