"""``express50 annotate ui``: the annotator in a terminal."""

from __future__ import annotations

import argparse
import fnmatch
import getpass
import sys
from collections.abc import Iterable
from pathlib import Path

from annotations.worklist import ORDERS
from express50.errors import AnnotationError
from express50.exclusions import included_subjects
from express50.index import read_index
from express50.layout import Dataset

PROTOCOLS = ("auto", "quadrant", "halfblock")


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
        "--protocol", choices=PROTOCOLS, default="auto", help="characters that pictures are made of"
    )
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
    from annotations.ui.app import AnnotateApp
    from annotations.ui.faces import FaceFinder
    from annotations.ui.terminal import choose_protocol

    protocol = choose_protocol(args.protocol)
    AnnotateApp(session, faces=FaceFinder(dataset), protocol=protocol).run()
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
