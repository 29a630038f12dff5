"""``express50 annotate ui``: the annotator in a terminal."""

from __future__ import annotations

import argparse
import fnmatch
import getpass
import os
import sys
from collections.abc import Iterable
from pathlib import Path

from annotations.ui.terminal import WANTED, cell_size, choose_pictures
from annotations.worklist import ORDERS
from express50.capture.index import read_index
from express50.contract.exclusions import included_subjects
from express50.contract.layout import Dataset
from express50.errors import AnnotationError


def add_verbs(verbs: argparse._SubParsersAction) -> None:
    """Add ``annotate ui``."""
    words = "label peak frames in the terminal"
    parser = verbs.add_parser("ui", help=words, description=words)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--annotator", default=getpass.getuser(), help="who (default: you)")
    parser.add_argument("--subjects", metavar="GLOB", help="only these subjects")
    parser.add_argument("--expressions", metavar="GLOB", help="only these expressions")
    parser.add_argument("--order", choices=ORDERS, default="doubt", help="what comes first")
    parser.add_argument(
        "--blind", action="store_true", help="hide suggestions and others' marks until you decide"
    )
    parser.add_argument(
        "--pictures", choices=WANTED, default="auto",
        help="how pictures are shown (default: the best that the terminal is known to have)",
    )  # fmt: skip
    parser.set_defaults(handler=run_ui)


def run_ui(args: argparse.Namespace) -> int:
    """Open the annotator; the exit code is 0 also when work is left."""
    from annotations.ui.session import open_session

    dataset = Dataset(args.dataset)
    subjects = matching(included_subjects(dataset), args.subjects, "subject")
    if not subjects:
        raise AnnotationError(f"{dataset.root}: no subject; run 'express50 ingest' first")
    names = dict.fromkeys(c.expression_id for s in subjects for c in read_index(dataset, s).cues)
    session = open_session(
        dataset,
        args.annotator,
        subjects=subjects,
        expressions=matching(names, args.expressions, "expression"),
        order=args.order,
        blind=args.blind,
    )
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise AnnotationError("the annotator needs a terminal; use 'express50 annotate mark' here")
    pictures = choose_pictures(args.pictures)
    if pictures in ("kitty", "sixel"):
        # They have every colour, but ssh does not hand COLORTERM on; kitty finds a picture by one.
        os.environ.setdefault("COLORTERM", "truecolor")
    from annotations.ui.app import AnnotateApp
    from annotations.ui.faces import FaceFinder

    faces = FaceFinder(dataset)
    AnnotateApp(session, faces=faces, pictures=pictures, cell=cell_size()).run()
    print(f"{session.done} of {len(session.tasks)} done by {session.annotator}")
    return 0


def matching(names: Iterable[str], pattern: str | None, what: str) -> list[str]:
    """Names that fit a pattern with ``*`` and ``?``; all for None.

    Raises:
        AnnotationError: none fits.
    """
    known = list(names)
    found = [name for name in known if fnmatch.fnmatchcase(name, pattern or "*")]
    if pattern is not None and not found:
        raise AnnotationError(f"no {what} fits {pattern!r}; there are {', '.join(known)}")
    return found
