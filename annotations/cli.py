"""``express50 annotate``: labels without a screen; the same store the align stage writes to."""

from __future__ import annotations

import argparse
import getpass
import json
import time
from dataclasses import asdict
from pathlib import Path

from annotations.store import (
    AUTOMATIC,
    Label,
    append_label,
    current_labels,
    make_mark,
    read_labels,
)
from express50.errors import AnnotationError
from express50.index import read_index
from express50.layout import Dataset


def add_commands(subparsers: argparse._SubParsersAction) -> None:
    """Add ``annotate mark|flag|undo|status|labels``."""
    annotate = subparsers.add_parser("annotate", help="label peak frames")
    verbs = annotate.add_subparsers(dest="verb", required=True)
    mark = _verb(verbs, "mark", "mark the peak frame of an expression", run_mark, one=True)
    mark.add_argument("frame", type=int, help="0-based frame")
    mark.add_argument("--camera", help="camera it was judged in (default: the first)")
    flag = _verb(verbs, "flag", "say that an expression cannot be labelled", run_flag, one=True)
    flag.add_argument("reason", help="failed, occluded, not performed, ...")
    _verb(verbs, "undo", "take one's last event on an expression back", run_undo, one=True)
    _verb(verbs, "status", "labels in force, by person and automatic", run_status, one=False)
    _verb(verbs, "labels", "every label in force", run_labels, one=False)


def _verb(verbs, name: str, help_text: str, handler, one: bool) -> argparse.ArgumentParser:
    parser = verbs.add_parser(name, help=help_text, description=help_text)
    parser.add_argument("dataset", type=Path)
    if one:
        parser.add_argument("subject")
        parser.add_argument("expression")
        parser.add_argument("--annotator", default=getpass.getuser(), help="who (default: you)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(handler=handler)
    return parser


def run_mark(args: argparse.Namespace) -> int:
    """Append a mark by a person."""
    dataset = Dataset(args.dataset)
    index = read_index(dataset, args.subject)
    camera = args.camera or next(iter(index.cameras))
    suggested = _suggested_frame(dataset, args.subject, args.expression)
    _person(args.annotator)
    mark = make_mark(index, args.expression, args.frame, camera, args.annotator, suggested)
    append_label(dataset, mark)
    return _say(args, mark, f"marked frame {args.frame}")


def _suggested_frame(dataset: Dataset, subject: str, expression: str) -> int | None:
    path = dataset.item_dir("align", subject) / "suggestions.json"
    if not path.exists():
        return None
    return json.loads(path.read_text()).get(expression, {}).get("frame")


def run_flag(args: argparse.Namespace) -> int:
    """Append a flag with its reason."""
    return _append_event(args, "flag", "flagged", reason=args.reason)


def run_undo(args: argparse.Namespace) -> int:
    """Append an undo."""
    return _append_event(args, "undo", "took the last event back")


def _append_event(
    args: argparse.Namespace, action: str, said: str, reason: str | None = None
) -> int:
    dataset = Dataset(args.dataset)
    index = read_index(dataset, args.subject)
    if args.expression not in {c.expression_id for c in index.cues}:
        known = ", ".join(c.expression_id for c in index.cues)
        raise AnnotationError(
            f"{args.subject}: no expression {args.expression!r} in cues.csv ({known})"
        )
    _person(args.annotator)
    event = Label(
        subject=args.subject,
        expression=args.expression,
        action=action,
        annotator=args.annotator,
        time=time.time(),
        reason=reason,
    )
    append_label(dataset, event)
    return _say(args, event, said)


def _person(annotator: str) -> None:
    if annotator == AUTOMATIC:
        raise AnnotationError(f"annotator {AUTOMATIC!r} is the align stage's own; give your name")


def _say(args: argparse.Namespace, label: Label, said: str) -> int:
    if args.json:
        print(json.dumps(asdict(label)))
    else:
        print(f"{label.subject} {label.expression}: {said} as {label.annotator};"
              f" run 'express50 align {args.dataset}' to use it")  # fmt: skip
    return 0


def run_status(args: argparse.Namespace) -> int:
    """Count the labels in force."""
    dataset = Dataset(args.dataset)
    rows = []
    for subject in dataset.subjects():
        labels = current_labels(read_labels(dataset, subject)).values()
        marks = [x for x in labels if x.action == "mark"]
        rows.append(
            {
                "subject": subject,
                "expressions": len(read_index(dataset, subject).cues),
                "by_person": sum(x.annotator != AUTOMATIC for x in marks),
                "automatic": sum(x.annotator == AUTOMATIC for x in marks),
                "flagged": sum(x.action == "flag" for x in labels),
            }
        )
    if args.json:
        print(json.dumps(rows))
        return 0
    print(f"{'subject':12} {'expressions':>11} {'by person':>10} {'automatic':>10} {'flagged':>8}")
    for row in rows:
        print(
            "{subject:12} {expressions:11} {by_person:10} {automatic:10} {flagged:8}".format(**row)
        )
    return 0


def run_labels(args: argparse.Namespace) -> int:
    """Print every label in force, one line each."""
    dataset = Dataset(args.dataset)
    for subject in dataset.subjects():
        for label in current_labels(read_labels(dataset, subject)).values():
            row = {k: v for k, v in asdict(label).items() if v is not None}
            if args.json:
                print(json.dumps(row, sort_keys=True))
            else:
                what = f"frame {label.frame}" if label.action == "mark" else label.action
                print(f"{subject} {label.expression}: {what} by {label.annotator}")
    return 0
