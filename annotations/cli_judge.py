"""Verbs that judge labels: validate, agree, review, coverage."""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import asdict

from annotations.agreement import agreement, by_expression, by_pair, marked_clips
from annotations.coverage import coverage
from annotations.labels import FLAG_REASONS
from annotations.options import add_annotator, add_selection, add_verb, chosen_subjects
from annotations.review import describe, disagreements, settlement
from annotations.store import append_label
from annotations.validate import problems
from express50.capture.index import read_index
from express50.console import FAILED, OK, format_table, say, say_json

_FIGURES = ("clips", "within_1", "within_2", "within_4", "median_frames", "slip_rate", "alpha")


def add_verbs(verbs) -> None:  # noqa: ANN001 - argparse's type is private
    """Add the verbs."""
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
    parser.add_argument("--all", action="store_true", help="also what is settled")
    parser.add_argument(
        "--settle", nargs=3, metavar=("SUBJECT", "EXPRESSION", "VERDICT"),
        help="verdict: a frame, the annotator who is right, or why there is no peak: "
        f"{', '.join(FLAG_REASONS)}, or flag:REASON",
    )  # fmt: skip
    add_verb(verbs, "coverage", "subjects against expressions, and what is missing", run_coverage)


def run_validate(args: argparse.Namespace) -> int:
    """Print what is wrong; gaps in coverage alone are no failure."""
    found = problems(args.dataset, chosen_subjects(args.dataset, args.subject))
    wrong = [p for p in found if p.kind != "coverage"]
    counts = dict(sorted(Counter(p.kind for p in found).items()))
    if args.json:
        say_json({"ok": not wrong, "counts": counts, "problems": [asdict(p) for p in found]})
    else:
        say(*(f"{p.subject} {p.expression}: {p.kind}: {p.what}" for p in wrong))
        say(f"{len(wrong)} wrong, {counts.get('coverage', 0)} without a label")
    return FAILED if wrong else OK


def run_agree(args: argparse.Namespace) -> int:
    """Print agreement."""
    clips = marked_clips(args.dataset, chosen_subjects(args.dataset, args.subject))
    overall, pairs, expressions = agreement(clips), by_pair(clips), by_expression(clips)
    if args.json:
        say_json({"overall": overall, "pairs": pairs, "expressions": expressions})
    elif not clips:
        say("no expression was marked by two people yet")
    else:
        rows = {"all": overall} | pairs | expressions
        cells = [[name, *("-" if r[f] is None else str(r[f]) for f in _FIGURES)]
                 for name, r in rows.items()]  # fmt: skip
        say(*format_table(["", *(f.replace("_", " ") for f in _FIGURES)], cells))
        say(f"alpha of all, 95 %: {overall['alpha_interval']}")
    return OK


def run_review(args: argparse.Namespace) -> int:
    """Print the queue, or settle one of it."""
    if args.settle:
        return _settle(args)
    wanted = chosen_subjects(args.dataset, args.subject)
    queue = disagreements(args.dataset, args.beyond, args.all, wanted)
    if args.json:
        say_json([row.to_json() for row in queue])
        return OK
    for row in queue:
        said = ", ".join(f"{who} {what}" for who, what in row.said.items())
        say(f"{row.subject} {row.expression}: {said}" + (f" -> {row.settled}" * bool(row.settled)))
    say(f"{len(queue)} to review")
    return OK


def _settle(args: argparse.Namespace) -> int:
    subject, expression, verdict = args.settle
    index = read_index(args.dataset, subject)
    label = settlement(args.dataset, index, expression, verdict, args.annotator)
    append_label(args.dataset, label)
    if args.json:
        say_json(asdict(label))
    else:
        say(f"{subject} {expression}: settled as {describe(label)} by {args.annotator}")
    return OK


def run_coverage(args: argparse.Namespace) -> int:
    """Print what is missing and who the subjects are."""
    report = coverage(args.dataset)
    if args.json:
        say_json(report)
        return OK
    states = ("person", "rule", "auto", "flagged", "missing")
    rows = [
        [subject, *(str(list(cells.values()).count(state)) for state in states)]
        for subject, cells in report["cells"].items()
    ]
    say(*format_table(["subject", *states], rows))
    say(*(f"{s}: missing {', '.join(gaps)}" for s, gaps in report["missing"].items()))
    say(*(f"{s}: excluded, {reason}" for s, reason in report["excluded"].items()))
    for name in ("gender", "age"):
        counts = ", ".join(f"{k} {n}" for k, n in report[name].items())
        say(f"{name}: {counts or 'too few people to count'}")
    return OK
