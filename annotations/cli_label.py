"""Verbs that give labels and say what is to do: suggest, next, mark, flag, undo, labels, status."""

from __future__ import annotations

import argparse
from dataclasses import asdict

from annotations.effort import effort, progress
from annotations.labels import FLAG_REASONS, Label, make_flag, make_mark, make_undo
from annotations.options import add_annotator, add_clip, add_selection, add_verb, chosen_subjects
from annotations.review import describe
from annotations.store import append_label, current_labels, last_event, read_labels
from annotations.suggestions import read_suggestions
from annotations.worklist import ORDERS, worklist
from express50.capture.index import read_index
from express50.console import OK, format_table, say, say_json
from express50.errors import AnnotationError


def add_verbs(verbs) -> None:  # noqa: ANN001 - argparse's type is private
    """Add the verbs."""
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
    add_verb(verbs, "status", "how far each subject is, and what labels cost", run_status)


def run_suggest(args: argparse.Namespace) -> int:
    """Print suggestions, least sure first."""
    wanted = chosen_subjects(args.dataset, args.subject) or args.dataset.subjects()
    rows = [
        {"subject": subject, "expression": expression} | asdict(suggestion)
        for subject in wanted
        for expression, suggestion in read_suggestions(args.dataset, subject).items()
    ]
    rows.sort(key=lambda row: row["confidence"])
    if args.json:
        say_json(rows)
    elif not rows:
        say(f"no suggestions; run 'express50 align {args.dataset.root}'")
    else:
        header = ["subject", "expression", "frame", "confidence", "kind"]
        cells = [[str(row[name]) for name in header] for row in rows]
        say(*format_table(header, cells))
    return OK


def run_next(args: argparse.Namespace) -> int:
    """Print the worklist's head."""
    wanted = chosen_subjects(args.dataset, args.subject)
    tasks = worklist(args.dataset, args.annotator, wanted, order=args.order)
    head = tasks[: max(0, args.count)]
    if args.json:
        say_json({"left": len(tasks), "tasks": [asdict(task) for task in head]})
        return OK
    rows = [[t.subject, t.expression, f"{t.doubt:.2f}"] for t in head]
    say(*format_table(["subject", "expression", "doubt"], rows), f"{len(tasks)} left")
    return OK


def run_mark(args: argparse.Namespace) -> int:
    """Append a mark by a person."""
    index = read_index(args.dataset, args.subject)
    hint = read_suggestions(args.dataset, args.subject).get(args.expression)
    camera = args.camera or (hint.camera if hint else "") or next(iter(index.cameras))
    mark = make_mark(
        index, args.expression, args.frame, camera, args.annotator,
        hint.frame if hint else None, hint.confidence if hint else None,
        first=args.first, last=args.last,
    )  # fmt: skip
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
    if args.json:
        say_json(asdict(label))
    else:
        say(
            f"{label.subject} {label.expression}: {said} as {label.annotator};"
            f" run 'express50 align {args.dataset.root}' to use it"
        )
    return OK


def run_labels(args: argparse.Namespace) -> int:
    """Print every label in force."""
    rows = [
        label
        for subject in chosen_subjects(args.dataset, args.subject) or args.dataset.subjects()
        for label in current_labels(read_labels(args.dataset, subject)).values()
    ]
    if args.json:
        say_json([{k: v for k, v in asdict(x).items() if v is not None} for x in rows])
    else:
        cells = [[x.subject, x.expression, describe(x), x.annotator] for x in rows]
        say(*format_table(["subject", "expression", "label", "by"], cells))
    return OK


def run_status(args: argparse.Namespace) -> int:
    """Count the labels in force, and what people spent on theirs."""
    subjects = [progress(args.dataset, subject) for subject in args.dataset.subjects()]
    people = effort(args.dataset)
    if args.json:
        say_json({"subjects": subjects, "annotators": people})
        return OK
    header = ["subject", "expressions", "by_person", "by_rule", "automatic", "flagged", "excluded"]
    cells = [["" if row[n] is None else str(row[n]) for n in header] for row in subjects]
    say(*format_table([name.replace("_", " ") for name in header], cells))
    if people:
        figures = next(iter(people.values()))
        rows = [
            [who, *("-" if v is None else str(v) for v in row.values())]
            for who, row in people.items()
        ]
        say("", *format_table(["annotator", *(n.replace("_", " ") for n in figures)], rows))
    return OK
