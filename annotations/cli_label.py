"""Verbs of ``express50 annotate`` that give labels: ui, suggest, next, mark, flag, undo, labels."""

from __future__ import annotations

import argparse
import fnmatch
import getpass
import os
import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from pathlib import Path

from annotations.agreement import describe
from annotations.labels import FLAG_REASONS, Label, make_flag, make_mark, make_undo, with_plateau
from annotations.store import append_label, current_labels, is_person, last_event, read_labels
from annotations.suggestions import read_suggestions
from annotations.worklist import ORDERS, worklist
from express50.capture.index import read_index
from express50.console import OK, format_table, say, say_json
from express50.contract.exclusions import included_subjects
from express50.contract.layout import Dataset
from express50.errors import AnnotationError

Handler = Callable[[argparse.Namespace], int]


def add_verb(verbs, name: str, words: str, handler: Handler) -> argparse.ArgumentParser:
    """Add a verb with the dataset and ``--json``."""
    parser = verbs.add_parser(name, help=words, description=words)
    parser.add_argument("dataset", type=existing_dataset, metavar="DATASET")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(handler=handler)
    return parser


def add_clip(parser: argparse.ArgumentParser) -> None:
    """Add the clip that a verb is about, and the annotator."""
    parser.add_argument("subject", metavar="SUBJECT")
    parser.add_argument("expression", metavar="EXPRESSION")
    add_annotator(parser)


def add_annotator(parser: argparse.ArgumentParser) -> None:
    """Add the annotator's name."""
    parser.add_argument(
        "--annotator", type=person, default=getpass.getuser(), metavar="NAME", help="you by default"
    )


def add_selection(parser: argparse.ArgumentParser) -> None:
    """Add a choice of subjects."""
    parser.add_argument("--subject", action="append", metavar="ID", help="only this; repeatable")


def answer(args: argparse.Namespace, data: object, *lines: str) -> int:
    """Print data as JSON where ``--json`` asks for it, else the lines."""
    if args.json:
        say_json(data)
    else:
        say(*lines)
    return OK


def existing_dataset(text: str) -> Dataset:
    """Parse the folder of an existing dataset."""
    if not Path(text).is_dir():
        raise argparse.ArgumentTypeError(
            f"{text}: no such dataset; run 'express50 ingest {text} CAPTURE'"
        )
    return Dataset(Path(text))


def person(text: str) -> str:
    """Parse a person's name: neither the align stage's, nor a rule's, nor empty."""
    if not text.strip() or not is_person(text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a valid annotator name; give yours")
    return text


def chosen_subjects(dataset: Dataset, wanted: list[str] | None) -> list[str] | None:
    """Check the subjects asked for; None for all.

    Raises:
        AnnotationError: one is not ingested.
    """
    for subject in wanted or ():
        if subject not in dataset.subjects():
            raise AnnotationError(
                f"{dataset.root}: no subject {subject!r}; expected one of"
                f" {', '.join(dataset.subjects()) or 'none: run express50 ingest'}"
            )
    return wanted


def add_label_verbs(verbs) -> None:  # noqa: ANN001 - argparse's type is private
    """Add the verbs."""
    parser = add_verb(verbs, "ui", "label peak frames in the terminal", run_ui)
    add_annotator(parser)
    parser.add_argument("--subjects", metavar="GLOB", help="only these subjects")
    parser.add_argument("--expressions", metavar="GLOB", help="only these expressions")
    parser.add_argument("--order", choices=ORDERS, default="doubt", help="what comes first")
    parser.add_argument(
        "--blind", action="store_true", help="hide suggestions and others' marks until you decide"
    )
    parser.add_argument(
        "--pictures", choices=("blocks", "sixel"), default="blocks",
        help="block characters, or sixels for terminals that draw them (xterm -ti vt340, foot,"
        " WezTerm, iTerm2) [%(default)s]",
    )  # fmt: skip
    add_selection(add_verb(verbs, "suggest", "what align suggests, doubtful first", run_suggest))
    parser = add_verb(verbs, "next", "what you still have to label, in the best order", run_next)
    add_selection(parser)
    add_annotator(parser)
    parser.add_argument("--order", choices=ORDERS, default=ORDERS[0], help="default: %(default)s")
    parser.add_argument("--count", type=int, default=10, metavar="N", help="at most so many [10]")
    parser = add_verb(verbs, "mark", "mark the peak frame of an expression", run_mark)
    add_clip(parser)
    parser.add_argument("frame", type=int, metavar="FRAME", help="0-based decode index")
    parser.add_argument("--camera", help="camera it was judged in (default: the suggestion's)")
    parser.add_argument("--first", type=int, metavar="FRAME", help="first frame of its plateau")
    parser.add_argument("--last", type=int, metavar="FRAME", help="last frame of its plateau")
    parser = add_verb(verbs, "flag", "say that an expression has no peak", run_flag)
    add_clip(parser)
    parser.add_argument("reason", metavar="REASON", help=", ".join(FLAG_REASONS) + ", ...")
    add_clip(add_verb(verbs, "undo", "take your last event on an expression back", run_undo))
    add_selection(add_verb(verbs, "labels", "every label in force", run_labels))


def run_ui(args: argparse.Namespace) -> int:
    """Open the annotator; the exit code is 0 also when work is left."""
    from annotations.ui.app import AnnotateApp
    from annotations.ui.frames import FaceFinder
    from annotations.ui.images import cell_size
    from annotations.ui.session import open_session

    dataset = args.dataset
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
    cell = None
    if args.pictures == "sixel":
        cell = cell_size()
        if cell is None:
            raise AnnotationError(
                "--pictures sixel: the terminal does not say how many pixels a cell has;"
                " use --pictures blocks"
            )
        os.environ.setdefault("COLORTERM", "truecolor")  # ssh does not hand it on
    AnnotateApp(session, faces=FaceFinder(dataset), sixel_cell=cell).run()
    done, total = session.done, len(session.tasks)
    words = f"{done} of {total} done by {session.annotator}"
    return answer(args, {"done": done, "tasks": total}, words)


def matching(names: Iterable[str], pattern: str | None, what: str) -> list[str]:
    """Find the names that fit a pattern with ``*`` and ``?``; all for None.

    Raises:
        AnnotationError: none fits.
    """
    known = list(names)
    found = [name for name in known if fnmatch.fnmatchcase(name, pattern or "*")]
    if pattern is not None and not found:
        raise AnnotationError(f"no {what} fits {pattern!r}; there are {', '.join(known)}")
    return found


def run_suggest(args: argparse.Namespace) -> int:
    """Print suggestions, least sure first."""
    wanted = chosen_subjects(args.dataset, args.subject) or args.dataset.subjects()
    rows = [
        {"subject": subject, "expression": expression} | asdict(suggestion)
        for subject in wanted
        for expression, suggestion in read_suggestions(args.dataset, subject).items()
    ]
    rows.sort(key=lambda row: row["confidence"])
    header = ["subject", "expression", "frame", "confidence", "kind"]
    table = format_table(header, [[str(row[name]) for name in header] for row in rows])
    none = f"no suggestions; run 'express50 align {args.dataset.root}'"
    return answer(args, rows, *(table if rows else [none]))


def run_next(args: argparse.Namespace) -> int:
    """Print the worklist's head."""
    wanted = chosen_subjects(args.dataset, args.subject)
    tasks = worklist(args.dataset, args.annotator, wanted, order=args.order)
    head = tasks[: max(0, args.count)]
    data = {"left": len(tasks), "tasks": [asdict(task) for task in head]}
    rows = [[t.subject, t.expression, f"{t.doubt:.2f}"] for t in head]
    table = format_table(["subject", "expression", "doubt"], rows)
    return answer(args, data, *table, f"{len(tasks)} left")


def run_mark(args: argparse.Namespace) -> int:
    """Append a mark by a person."""
    index = read_index(args.dataset, args.subject)
    hint = read_suggestions(args.dataset, args.subject).get(args.expression)
    camera = args.camera or (hint.camera if hint else "") or next(iter(index.cameras))
    mark = make_mark(index, args.expression, args.frame, camera, args.annotator)
    mark = with_plateau(mark, index, args.first, args.last)
    if hint is not None:
        mark = replace(mark, suggested=hint.frame, confidence=hint.confidence)
    return _keep(args, mark, f"marked frame {args.frame}")


def run_flag(args: argparse.Namespace) -> int:
    """Append a flag with its reason."""
    index = read_index(args.dataset, args.subject)
    flag = make_flag(index, args.expression, args.reason, args.annotator)
    return _keep(args, flag, "flagged")


def run_undo(args: argparse.Namespace) -> int:
    """Append an undo."""
    index = read_index(args.dataset, args.subject)
    undo = make_undo(index, args.expression, args.annotator)
    events = read_labels(args.dataset, args.subject)
    if last_event(events, args.expression, args.annotator) is None:
        raise AnnotationError(
            f"{args.subject} {args.expression}: {args.annotator} has nothing there to take back"
        )
    return _keep(args, undo, "took the last event back")


def _keep(args: argparse.Namespace, label: Label, said: str) -> int:
    append_label(args.dataset, label)
    words = (
        f"{label.subject} {label.expression}: {said} as {label.annotator};"
        f" run 'express50 align {args.dataset.root}' to use it"
    )
    return answer(args, asdict(label), words)


def run_labels(args: argparse.Namespace) -> int:
    """Print every label in force."""
    rows = [
        label
        for subject in chosen_subjects(args.dataset, args.subject) or args.dataset.subjects()
        for label in current_labels(read_labels(args.dataset, subject)).values()
    ]
    data = [{k: v for k, v in asdict(x).items() if v is not None} for x in rows]
    cells = [[x.subject, x.expression, describe(x), x.annotator] for x in rows]
    return answer(args, data, *format_table(["subject", "expression", "label", "by"], cells))
