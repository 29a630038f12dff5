"""Verbs that manage labels: reference, rule, exclude, include, export, import."""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from pathlib import Path

from annotations.exchange import export_labels, import_labels
from annotations.labels import Label
from annotations.options import add_annotator, add_selection, add_verb, chosen_subjects
from annotations.reference import choose_reference, reference_subject
from annotations.rules import LAST_FRAME, last_frame_marks
from annotations.store import append_label, read_labels
from express50.capture.index import read_index
from express50.console import OK, say, say_json
from express50.contract.exclusions import included_subjects
from express50.errors import AnnotationError


def add_verbs(verbs) -> None:  # noqa: ANN001 - argparse's type is private
    """Add the verbs."""
    words = "say or choose whose frames the others are matched to"
    parser = add_verb(verbs, "reference", words, run_reference)
    parser.add_argument("subject", nargs="?", metavar="SUBJECT", help="new reference")
    words = "label by RenderMe-360's rule: the last frame of a clip is its peak"
    parser = add_verb(verbs, "rule", words, run_rule)
    add_selection(parser)
    parser.add_argument(
        "--expression", action="append", metavar="ID", help="repeatable; e0 to e11 by default"
    )
    for name, words in (
        ("exclude", "leave a subject out, with the reason"),
        ("include", "take an excluded subject back in"),
    ):
        parser = add_verb(verbs, name, words, run_exclusion)
        parser.add_argument("subject", metavar="SUBJECT")
        if name == "exclude":
            parser.add_argument("reason", metavar="REASON", help="heavy makeup, large glasses, ...")
        add_annotator(parser)
    parser = add_verb(verbs, "export", "write every event as .csv or .json", run_export)
    add_selection(parser)
    parser.add_argument("file", type=Path, metavar="FILE")
    parser = add_verb(verbs, "import", "take events of a .csv or .json in, once each", run_import)
    parser.add_argument("file", type=Path, metavar="FILE")


def run_reference(args: argparse.Namespace) -> int:
    """Print the reference, or make another subject it."""
    if args.subject is not None:
        choose_reference(args.dataset, args.subject)
    subject = reference_subject(args.dataset)
    if args.json:
        say_json({"reference": subject})
    else:
        say(f"reference: {subject}")
    return OK


def run_rule(args: argparse.Namespace) -> int:
    """Append the rule's marks; people's labels stand above them."""
    chosen = chosen_subjects(args.dataset, args.subject) or included_subjects(args.dataset)
    marks = [
        mark
        for subject in chosen
        for mark in last_frame_marks(
            args.dataset, read_index(args.dataset, subject), args.expression
        )
    ]
    for mark in marks:
        append_label(args.dataset, mark)
    if args.json:
        say_json([asdict(mark) for mark in marks])
    else:
        say(f"{len(marks)} marks by {LAST_FRAME} in {len(chosen)} subjects")
    return OK


def run_exclusion(args: argparse.Namespace) -> int:
    """Append an exclusion, or its end."""
    chosen_subjects(args.dataset, [args.subject])
    reason = args.reason.strip() if args.verb == "exclude" else None
    if reason == "":
        raise AnnotationError(f"{args.subject}: an exclusion needs a reason, as 'heavy makeup'")
    event = Label(
        subject=args.subject, expression="", action=args.verb, annotator=args.annotator,
        time=time.time(), reason=reason,
    )  # fmt: skip
    append_label(args.dataset, event)
    if args.json:
        say_json(asdict(event))
    else:
        reason = f": {event.reason}" if event.reason else ""
        say(f"{args.subject}: {args.verb}d{reason}")
    return OK


def run_export(args: argparse.Namespace) -> int:
    """Write the events."""
    chosen = chosen_subjects(args.dataset, args.subject) or args.dataset.subjects()
    events = [label for subject in chosen for label in read_labels(args.dataset, subject)]
    count = export_labels(events, args.file)
    if args.json:
        say_json({"file": str(args.file), "events": count})
    else:
        say(f"{args.file}: {count} events of {len(chosen)} subjects")
    return OK


def run_import(args: argparse.Namespace) -> int:
    """Append what is new."""
    new, known = import_labels(args.dataset, args.file)
    if args.json:
        say_json({"file": str(args.file), "new": new, "known": known})
    else:
        say(f"{args.file}: {new} new events, {known} known already")
    return OK
