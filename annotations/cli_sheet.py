"""``express50 annotate sheet``: labels at a glance, as one page to open anywhere."""

from __future__ import annotations

import argparse
from pathlib import Path

from annotations.options import add_selection, add_verb, chosen_subjects
from annotations.sheet import SURE, make_sheet
from express50.console import OK, say, say_json

AROUND = 4  # frames on either side where one subject or expression is looked at


def add_verbs(verbs) -> None:  # noqa: ANN001 - argparse's type is private
    """Add the verb."""
    words = "write a contact sheet of all labels, or of a subject or expression, as one HTML file"
    parser = add_verb(verbs, "sheet", words, run_sheet)
    parser.add_argument("file", type=Path, metavar="OUT.html")
    add_selection(parser)
    parser.add_argument("--expression", action="append", metavar="ID", help="only this; repeatable")
    parser.add_argument("--camera", metavar="ID", help="show this camera (default: the label's)")
    parser.add_argument(
        "--around", type=int, metavar="N",
        help="frames before and after each label [4 for chosen subjects or expressions, else 0]",
    )  # fmt: skip
    parser.add_argument(
        "--sure", type=float, default=SURE, metavar="P",
        help="outline suggestions less sure than this [%(default)s]",
    )  # fmt: skip


def run_sheet(args: argparse.Namespace) -> int:
    """Write the page."""
    from annotations.sheet_page import render_sheet
    from annotations.ui.faces import FaceFinder
    from express50.files.atomic import write_bytes

    wanted = chosen_subjects(args.dataset, args.subject)
    sheet = make_sheet(args.dataset, wanted, args.expression, args.camera, args.sure)
    chosen = args.subject or args.expression
    around = args.around if args.around is not None else AROUND if chosen else 0
    faces = FaceFinder(args.dataset)
    faces.load()
    page = render_sheet(args.dataset, sheet, faces=faces, around=max(0, around)).encode()
    args.file.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(args.file, page)
    counts = sheet.counts()
    if args.json:
        say_json({"file": str(args.file), "bytes": len(page), "tiles": counts})
    else:
        said = ", ".join(f"{name} {count}" for name, count in counts.items() if count)
        say(f"{args.file} ({len(page):,} bytes): {said}")
    return OK
