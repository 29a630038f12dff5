"""``express50 annotate``: all verbs, and those that check, compare and manage labels."""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import asdict
from pathlib import Path

from annotations.agreement import (
    agreement,
    by_expression,
    by_pair,
    describe,
    disagreements,
    marked_clips,
    settlement,
)
from annotations.cli_label import (
    add_annotator,
    add_label_verbs,
    add_selection,
    add_verb,
    answer,
    chosen_subjects,
)
from annotations.exchange import LAST_FRAME, export_labels, import_labels, last_frame_marks
from annotations.labels import FLAG_REASONS, Label
from annotations.store import append_label, read_labels
from annotations.suggestions import choose_reference, reference_subject
from annotations.validate import problems
from annotations.worklist import coverage, effort, progress
from express50.capture.index import read_index
from express50.console import FAILED, OK, format_table
from express50.contract.exclusions import included_subjects
from express50.errors import AnnotationError

_FIGURES = ("clips", "within_1", "within_2", "within_4", "median_frames", "slip_rate", "alpha")
AROUND = 4  # frames on either side where one subject or expression is looked at


def add_commands(subparsers: argparse._SubParsersAction) -> None:
    """Add ``annotate`` with its verbs."""
    words = "label peak frames, compare annotators, review and export"
    annotate = subparsers.add_parser("annotate", help=words, description=words)
    verbs = annotate.add_subparsers(dest="verb", metavar="VERB", required=True)
    add_label_verbs(verbs)
    _add_comparing_verbs(verbs)
    _add_managing_verbs(verbs)


def _add_comparing_verbs(verbs) -> None:  # noqa: ANN001 - argparse's type is private
    words = "check labels against the footage and each other; exit code 1 when one is wrong"
    add_selection(add_verb(verbs, "validate", words, run_validate))
    words = "how well annotators agree, overall, by expression and by pair"
    add_selection(add_verb(verbs, "agree", words, run_agree))
    words = "list disagreements, or settle one"
    parser = add_verb(verbs, "review", words, run_review)
    add_selection(parser)
    add_annotator(parser)
    parser.add_argument(
        "--beyond", type=int, default=2, metavar="FRAMES", help="marks so close agree [2]"
    )
    parser.add_argument("--all", action="store_true", help="also settled ones")
    parser.add_argument(
        "--settle", nargs=3, metavar=("SUBJECT", "EXPRESSION", "VERDICT"),
        help="verdict: a frame, the annotator who is right, or the reason for a flag: "
        f"{', '.join(FLAG_REASONS)}, or flag:REASON",
    )  # fmt: skip
    add_verb(verbs, "coverage", "subjects against expressions, with the gaps", run_coverage)
    add_verb(verbs, "status", "how far each subject is, and what labels cost", run_status)
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
        "--sure", type=float, default=0.5, metavar="P",
        help="outline suggestions less sure than this [%(default)s]",
    )  # fmt: skip


def _add_managing_verbs(verbs) -> None:  # noqa: ANN001 - argparse's type is private
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


def run_validate(args: argparse.Namespace) -> int:
    """Print the problems; gaps in coverage alone are not a failure."""
    found = problems(args.dataset, chosen_subjects(args.dataset, args.subject))
    wrong = [p for p in found if p.kind != "coverage"]
    counts = dict(sorted(Counter(p.kind for p in found).items()))
    data = {"ok": not wrong, "counts": counts, "problems": [asdict(p) for p in found]}
    lines = [f"{p.subject} {p.expression}: {p.kind}: {p.what}" for p in wrong]
    answer(args, data, *lines, f"{len(wrong)} wrong, {counts.get('coverage', 0)} without a label")
    return FAILED if wrong else OK


def run_agree(args: argparse.Namespace) -> int:
    """Print agreement."""
    clips = marked_clips(args.dataset, chosen_subjects(args.dataset, args.subject))
    overall, pairs, expressions = agreement(clips), by_pair(clips), by_expression(clips)
    data = {"overall": overall, "pairs": pairs, "expressions": expressions}
    if not clips:
        return answer(args, data, "no expression was marked by two people yet")
    rows = {"all": overall} | pairs | expressions
    cells = [[name, *("-" if r[f] is None else str(r[f]) for f in _FIGURES)]
             for name, r in rows.items()]  # fmt: skip
    table = format_table(["", *(f.replace("_", " ") for f in _FIGURES)], cells)
    return answer(args, data, *table, f"alpha of all, 95 %: {overall['alpha_interval']}")


def run_review(args: argparse.Namespace) -> int:
    """Print the queue, or settle one of it."""
    if args.settle:
        subject, expression, verdict = args.settle
        index = read_index(args.dataset, subject)
        label = settlement(args.dataset, index, expression, verdict, args.annotator)
        append_label(args.dataset, label)
        words = f"{subject} {expression}: settled as {describe(label)} by {args.annotator}"
        return answer(args, asdict(label), words)
    wanted = chosen_subjects(args.dataset, args.subject)
    queue = disagreements(args.dataset, args.beyond, args.all, wanted)
    lines = []
    for row in queue:
        said = ", ".join(f"{who} {what}" for who, what in row.said.items())
        settled = f" -> {row.settled}" if row.settled else ""
        lines.append(f"{row.subject} {row.expression}: {said}{settled}")
    return answer(args, [asdict(row) for row in queue], *lines, f"{len(queue)} to review")


def run_coverage(args: argparse.Namespace) -> int:
    """Print the missing labels and the counts of the subjects' gender and age."""
    report = coverage(args.dataset)
    states = ("person", "rule", "auto", "flagged", "missing")
    rows = [
        [subject, *(str(list(cells.values()).count(state)) for state in states)]
        for subject, cells in report["cells"].items()
    ]
    lines = list(format_table(["subject", *states], rows))
    lines += [f"{s}: missing {', '.join(gaps)}" for s, gaps in report["missing"].items()]
    lines += [f"{s}: excluded, {reason}" for s, reason in report["excluded"].items()]
    for name in ("gender", "age"):
        counts = ", ".join(f"{k} {n}" for k, n in report[name].items())
        lines.append(f"{name}: {counts or 'too few people to count'}")
    return answer(args, report, *lines)


def run_status(args: argparse.Namespace) -> int:
    """Count the labels in force, and what people spent on theirs."""
    subjects = [progress(args.dataset, subject) for subject in args.dataset.subjects()]
    people = effort(args.dataset)
    header = ["subject", "expressions", "by_person", "by_rule", "automatic", "flagged", "excluded"]
    cells = [["" if row[n] is None else str(row[n]) for n in header] for row in subjects]
    lines = list(format_table([name.replace("_", " ") for name in header], cells))
    if people:
        figures = next(iter(people.values()))
        rows = [
            [who, *("-" if v is None else str(v) for v in row.values())]
            for who, row in people.items()
        ]
        lines += ["", *format_table(["annotator", *(n.replace("_", " ") for n in figures)], rows)]
    return answer(args, {"subjects": subjects, "annotators": people}, *lines)


def run_sheet(args: argparse.Namespace) -> int:
    """Write the page."""
    from annotations.sheet import make_sheet, render_sheet
    from annotations.ui.frames import FaceFinder
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
    said = ", ".join(f"{name} {count}" for name, count in counts.items() if count)
    data = {"file": str(args.file), "bytes": len(page), "tiles": counts}
    return answer(args, data, f"{args.file} ({len(page):,} bytes): {said}")


def run_reference(args: argparse.Namespace) -> int:
    """Print the reference, or make another subject it."""
    if args.subject is not None:
        choose_reference(args.dataset, args.subject)
    subject = reference_subject(args.dataset)
    return answer(args, {"reference": subject}, f"reference: {subject}")


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
    words = f"{len(marks)} marks by {LAST_FRAME} in {len(chosen)} subjects"
    return answer(args, [asdict(mark) for mark in marks], words)


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
    because = f": {event.reason}" if event.reason else ""
    return answer(args, asdict(event), f"{args.subject}: {args.verb}d{because}")


def run_export(args: argparse.Namespace) -> int:
    """Write the events."""
    chosen = chosen_subjects(args.dataset, args.subject) or args.dataset.subjects()
    events = [label for subject in chosen for label in read_labels(args.dataset, subject)]
    count = export_labels(events, args.file)
    words = f"{args.file}: {count} events of {len(chosen)} subjects"
    return answer(args, {"file": str(args.file), "events": count}, words)


def run_import(args: argparse.Namespace) -> int:
    """Append the new events."""
    new, known = import_labels(args.dataset, args.file)
    data = {"file": str(args.file), "new": new, "known": known}
    return answer(args, data, f"{args.file}: {new} new events, {known} known already")
