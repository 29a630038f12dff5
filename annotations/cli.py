"""``express50 annotate`` gives labels, compares annotators, reviews, exports and imports."""

from __future__ import annotations

import argparse
import fnmatch
import getpass
import os
import sys
import time
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from annotations.exchange import LAST_FRAME, export_labels, import_labels, last_frame_marks
from annotations.labels import (
    FLAG_REASONS,
    Label,
    append_label,
    current_labels,
    is_person,
    last_event,
    make_event,
    make_flag,
    make_mark,
    overruling,
    read_labels,
)
from annotations.suggestions import choose_reference, read_suggestions, reference_subject
from annotations.validate import (
    agreement,
    by_expression,
    by_pair,
    describe,
    disagreements,
    in_spite_of,
    marked_clips,
    problems,
    settlement,
)
from annotations.worklist import ORDERS, coverage, effort, progress, worklist
from express50.capture.index import Index, read_index
from express50.console import FAILED, OK, add_command, answer, count, format_table, log, number
from express50.contract.layout import (
    Dataset,
    check_folder,
    check_page_file,
    check_results_file,
    exclusion_reason,
    included_subjects,
)
from express50.errors import AnnotationError, ConfigError, UnknownNameError, advised, check_known

_FIGURES = ("clips", "within_1", "within_2", "within_4", "median_frames", "slip_rate", "alpha")
AROUND = 4  # frames on either side when one subject or expression is shown


def add_commands(subparsers: argparse._SubParsersAction) -> None:
    """Add ``annotate`` with its actions."""
    words = "label peak frames, review and export labels"
    annotate = subparsers.add_parser("annotate", help=words)
    actions = annotate.add_subparsers(dest="action", metavar="ACTION", required=True)

    def add(name: str, handler: Callable, words: str, *shared: str) -> Callable:
        """Add an action with some shared arguments; return the function that adds its own."""
        parser = add_command(actions, name, handler, words, dataset=False)
        argument = parser.add_argument
        argument("dataset", type=dataset_folder, metavar="DATASET", help="folder of the dataset")
        for kind in ("subject", "expression"):
            if f"{kind}s" in shared:
                words = f"only this {kind}; may be repeated (default: all)"
                argument(f"--{kind}", action="append", metavar="ID", help=words)
        if "subject" in shared or "clip" in shared:
            argument("subject", metavar="SUBJECT", help="subject's id")
        if "clip" in shared:
            argument("expression", metavar="EXPRESSION", help="expression's id")
        if "annotator" in shared:
            words = "annotator's name (default: your login)"
            login = None
            with suppress(KeyError, OSError):  # some containers have no login names
                login = getpass.getuser()
            argument(
                "--annotator", type=person, default=login, required=login is None, metavar="NAME",
                help=words,
            )  # fmt: skip
        return argument

    _add_labelling_actions(add)
    _add_reviewing_actions(add)
    words = "print or choose the reference person, to whose frames all others are matched"
    argument = add("reference", run_reference, words)
    argument(
        "subject",
        nargs="?",
        metavar="SUBJECT",
        help="new reference (default: print the present one)",
    )
    words = "label clips (e0 to e11, or --expression) by RenderMe-360's last-frame rule"
    add("rule", run_rule, words, "subjects", "expressions")
    words = "exclude a subject from all stages, and record the reason"
    argument = add("exclude", run_exclusion, words, "subject", "annotator")
    argument("reason", metavar="REASON", help="such as 'heavy makeup' or 'large glasses'")
    words = "include an excluded subject again"
    add("include", run_exclusion, words, "subject", "annotator")
    words = "write every label event to a file"
    argument = add("export", run_export, words, "subjects")
    argument("file", type=Path, metavar="FILE", help=".csv or .json")
    words = "add label events from a file, and skip those that the dataset has"
    argument = add("import", run_import, words)
    argument("file", type=Path, metavar="FILE", help=".csv or .json")


def _add_labelling_actions(add: Callable[..., Callable]) -> None:
    argument = add("ui", run_ui, "label peak frames in the terminal", "annotator")
    argument(
        "--subjects", metavar="GLOB", help="only subjects that match, such as 'S00*' (default: all)"
    )
    argument("--expressions", metavar="GLOB", help="only expressions that match (default: all)")
    order = "most doubtful first, by expression, or by subject (default: %(default)s)"
    argument("--order", choices=ORDERS, default="doubt", help=order)
    words = "hide suggestions and others' marks until you decide"
    argument("--blind", action="store_true", help=words)
    words = "block characters (grey, unless COLORTERM is truecolor), or sixels for terminals that"
    words += " draw them (xterm -ti vt340, foot, WezTerm, iTerm2) (default: %(default)s)"
    argument("--pictures", choices=("blocks", "sixel"), default="blocks", help=words)
    words = "list the frames that align suggests, the most doubtful first"
    add("suggest", run_suggest, words, "subjects")
    words = "list what you still have to label, in the best order"
    argument = add("next", run_next, words, "subjects", "annotator")
    argument("--order", choices=ORDERS, default=ORDERS[0], help=order)
    words = "list at most this many (default: %(default)s)"
    argument("--count", type=number(0), default=10, metavar="N", help=words)
    argument = add("mark", run_mark, "mark the peak frame of an expression", "clip", "annotator")
    argument("frame", type=number(0), metavar="FRAME", help="the frame's decode index, from 0")
    words = "camera in which you judged it (default: the suggestion's)"
    argument("--camera", metavar="ID", help=words)
    argument("--first", type=number(0), metavar="FRAME", help="first frame of the plateau")
    argument("--last", type=number(0), metavar="FRAME", help="last frame of the plateau")
    argument = add("flag", run_flag, "record that an expression has no peak", "clip", "annotator")
    argument("reason", metavar="REASON", help=", ".join(FLAG_REASONS) + ", or your own words")
    add("undo", run_undo, "undo your last label of an expression", "clip", "annotator")
    add("labels", run_labels, "list every label in force", "subjects")


def _add_reviewing_actions(add: Callable[..., Callable]) -> None:
    words = "check labels against the footage and each other; exit code 1 if one is wrong"
    add("validate", run_validate, words, "subjects")
    words = "show how well annotators agree: overall, by expression and by pair"
    add("agree", run_agree, words, "subjects")
    words = "list disagreements, or settle one"
    argument = add("review", run_review, words, "subjects", "annotator")
    words = "marks at most this many frames apart agree (default: %(default)s)"
    argument("--beyond", type=number(0), default=2, metavar="FRAMES", help=words)
    argument("--all", action="store_true", help="also list settled disagreements")
    words = "VERDICT is a frame, the annotator who is right, or the reason for a flag: "
    words += f"{', '.join(FLAG_REASONS)}, or flag:REASON"
    argument("--settle", nargs=3, metavar=("SUBJECT", "EXPRESSION", "VERDICT"), help=words)
    words = "print a table of subjects and expressions that shows which labels are missing"
    add("coverage", run_coverage, words)
    add("status", run_status, "show how many labels each subject has, and the time they took")
    words = "write a contact sheet of all labels, or of a subject or expression, as one HTML file"
    argument = add("sheet", run_sheet, words, "subjects", "expressions")
    argument("file", type=Path, metavar="OUT.html", help="page to write")
    argument("--camera", metavar="ID", help="show this camera (default: the label's)")
    words = "frames to show before and after each label (default: 4 with --subject or --expression,"
    words += " else 0)"
    argument("--around", type=number(0), metavar="N", help=words)
    words = "outline suggestions with less confidence than this (default: %(default)s)"
    argument("--sure", type=number(0, 1, float), default=0.5, metavar="P", help=words)


def table(names: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Lay out some columns of rows; None is shown as a dash."""
    cells = [["-" if row[name] is None else str(row[name]) for name in names] for row in rows]
    return list(format_table([name.replace("_", " ") for name in names], cells))


def dataset_folder(text: str) -> Dataset:
    """Parse the folder of an existing dataset."""
    dataset = Dataset(Path(text))
    check_folder(dataset)
    if not dataset.captures_file.is_file():
        ingest = advised("express50 ingest", dataset.root, "CAPTURE")
        raise ConfigError(f"{text}: not a dataset (no captures.json); run {ingest}")
    return dataset


def person(text: str) -> str:
    """Parse a person's name: neither the align stage's nor a rule's."""
    if not is_person(text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a valid annotator name; give yours")
    return unicodedata.normalize("NFC", text.strip())  # one person, however the name was typed


def chosen_subjects(dataset: Dataset, wanted: list[str] | None) -> list[str] | None:
    """Return the subjects asked for, None for all; AnnotationError if one is not ingested."""
    check_known(str(dataset.root), "subject", wanted or (), dataset.subjects())
    return wanted


def run_ui(args: argparse.Namespace) -> int:
    """Open the annotator; the exit code is 0 even if work is left."""
    from annotations.ui.app import AnnotateApp
    from annotations.ui.frames import FaceFinder
    from annotations.ui.images import cell_size
    from annotations.ui.session import Session

    dataset = args.dataset
    subjects = _matching(included_subjects(dataset), args.subjects, "included subject")
    if not subjects:
        raise AnnotationError(f"{dataset.root}: no subject is ingested, or all are excluded")
    names = dict.fromkeys(c.expression_id for s in subjects for c in read_index(dataset, s).cues)
    session = Session(
        dataset,
        args.annotator,
        subjects=subjects,
        expressions=_matching(names, args.expressions, "expression"),
        order=args.order,
        blind=args.blind,
    )
    _check_terminal(dataset.root)
    cell = None
    if args.pictures == "sixel":
        cell = cell_size()
        os.environ.setdefault("COLORTERM", "truecolor")  # ssh does not pass it on
    # Rich sees 16 colours in "screen", "alacritty" and others, which draw 256.
    os.environ["TERM"] += "-256color"
    AnnotateApp(session, faces=FaceFinder(dataset), sixel_cell=cell).run()
    done, total = session.done, len(session.tasks)
    words = f"{done} of {total} done by {session.annotator}"
    after = f"run {advised('express50 align', dataset.root)} to use the labels"
    return answer(args, {"done": done, "tasks": total}, f"{words}; {after}")


def _check_terminal(root: Path) -> None:
    """Raise AnnotationError unless the terminal can position text and shows Unicode."""
    mark = advised("express50 annotate mark", root, "SUBJECT EXPRESSION FRAME")
    without = f"use {mark} here"
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise AnnotationError(f"the annotator needs a terminal; {without}")
    name = os.environ.get("TERM", "")
    if name in ("", "dumb", "unknown"):
        raise AnnotationError(
            f"TERM is {name!r}, which cannot position text; set TERM to your terminal's type, such"
            f" as xterm-256color, or {without}"
        )
    if sys.stdout.encoding.lower().replace("-", "") != "utf8":
        raise AnnotationError(
            f"the annotator needs UTF-8, but this terminal's encoding is {sys.stdout.encoding};"
            f" set LC_ALL=C.UTF-8 and unset PYTHONIOENCODING, or {without}"
        )


def _matching(names: Iterable[str], pattern: str | None, what: str) -> list[str]:
    """Find the names that fit a pattern with ``*`` and ``?``; all for None."""
    known = list(names)
    found = [name for name in known if fnmatch.fnmatchcase(name, pattern or "*")]
    if pattern is not None and not found:
        listed = ", ".join(known)
        raise UnknownNameError(f"no {what} matches {pattern!r}; expected one or more of {listed}")
    return found


def run_suggest(args: argparse.Namespace) -> int:
    """Print suggestions, least sure first."""
    rows = [
        {"subject": subject, "expression": expression} | asdict(suggestion)
        for subject in chosen_subjects(args.dataset, args.subject) or args.dataset.subjects()
        for expression, suggestion in read_suggestions(args.dataset, subject).items()
    ]
    rows.sort(key=lambda row: row["confidence"])
    lines = table(("subject", "expression", "frame", "confidence", "kind"), rows)
    none = f"no suggestions; run {advised('express50 align', args.dataset.root)}"
    return answer(args, rows, *(lines if rows else [none]))


def run_next(args: argparse.Namespace) -> int:
    """Print the first tasks of the worklist."""
    tasks = worklist(args.dataset, args.annotator, args.subject, order=args.order)
    head = [asdict(task) for task in tasks[: args.count]]
    rows = [row | {"doubt": f"{row['doubt']:.2f}"} for row in head]
    lines = table(("subject", "expression", "doubt"), rows)
    return answer(args, {"left": len(tasks), "tasks": head}, *lines, f"{len(tasks)} left")


def _index(args: argparse.Namespace) -> Index:
    chosen_subjects(args.dataset, [args.subject])
    return read_index(args.dataset, args.subject)


def run_mark(args: argparse.Namespace) -> int:
    """Append a mark by a person."""
    index = _index(args)
    hint = read_suggestions(args.dataset, args.subject).get(args.expression)
    camera = args.camera or (hint.camera if hint else "") or next(iter(index.cameras))
    mark = make_mark(
        index, args.expression, args.frame, camera, args.annotator, args.first, args.last
    )
    if hint is not None:
        mark = replace(mark, suggested=hint.frame, confidence=hint.confidence)
    return _keep(args, mark, f"frame {args.frame} marked")


def run_flag(args: argparse.Namespace) -> int:
    """Append a flag with its reason."""
    flag = make_flag(_index(args), args.expression, args.reason, args.annotator)
    return _keep(args, flag, f"flagged {flag.reason!r}")


def run_undo(args: argparse.Namespace) -> int:
    """Append an undo."""
    undo = make_event(_index(args), args.expression, "undo", args.annotator)
    events = read_labels(args.dataset, args.subject)
    last = last_event(events, args.expression, args.annotator)
    if last is None:
        raise AnnotationError(
            f"{args.subject} {args.expression}: {args.annotator} has no label on it to undo;"
            f" {_in_force(events, args.expression)}"
        )
    return _keep(args, undo, f"{describe(last)} undone")


def _in_force(events: Sequence[Label], expression: str) -> str:
    label = current_labels(events).get(expression)
    return (
        f"{describe(label)} by {label.annotator} is in force" if label else "no label is in force"
    )


def _keep(args: argparse.Namespace, label: Label, said: str) -> int:
    label = append_label(args.dataset, label)
    events = read_labels(args.dataset, label.subject)
    after = f"run {advised('express50 align', args.dataset.root)} to use it"
    if (settled := overruling(events, label)) is not None:
        after = in_spite_of(settled)
    elif label.action == "undo":
        after = f"now {_in_force(events, label.expression)}; {after}"
    words = f"{label.subject} {label.expression}: {said} by {label.annotator}; {after}"
    return answer(args, asdict(label), words)


def run_labels(args: argparse.Namespace) -> int:
    """Print every label in force."""
    rows = [
        label
        for subject in chosen_subjects(args.dataset, args.subject) or args.dataset.subjects()
        for label in current_labels(read_labels(args.dataset, subject)).values()
    ]
    data = [{k: v for k, v in asdict(x).items() if v is not None} for x in rows]
    cells = [asdict(x) | {"label": describe(x), "by": x.annotator} for x in rows]
    return answer(args, data, *table(("subject", "expression", "label", "by"), cells))


def run_validate(args: argparse.Namespace) -> int:
    """Print the problems; missing labels alone are not a failure."""
    found = problems(args.dataset, chosen_subjects(args.dataset, args.subject))
    wrong = [p for p in found if p.kind != "coverage"]
    counts = dict(sorted(Counter(p.kind for p in found).items()))
    data = {"ok": not wrong, "counts": counts, "problems": [asdict(p) for p in found]}
    lines = [f"{p.subject} {p.expression}".rstrip() + f": {p.kind}: {p.what}" for p in wrong]
    answer(args, data, *lines, f"{len(wrong)} wrong, {counts.get('coverage', 0)} without a label")
    return FAILED if wrong else OK


def run_agree(args: argparse.Namespace) -> int:
    """Print agreement."""
    clips = marked_clips(args.dataset, chosen_subjects(args.dataset, args.subject))
    overall, pairs, expressions = agreement(clips), by_pair(clips), by_expression(clips)
    data = {"overall": overall, "pairs": pairs, "expressions": expressions}
    if not clips:
        return answer(args, data, "no expression was marked by two people yet")
    groups = {"all": overall} | pairs | expressions
    lines = table(("of", *_FIGURES), [{"of": name} | row for name, row in groups.items()])
    if any(row["alpha"] is None for row in groups.values()):
        lines.append("alpha is n/a (-) for a single clip, and where all marks are at the same time")
    interval = overall["alpha_interval"] or "n/a (too few clips)"
    return answer(args, data, *lines, f"Krippendorff's alpha of all, 95 % interval: {interval}")


def run_review(args: argparse.Namespace) -> int:
    """Print the disagreements, or settle one."""
    if args.settle:
        subject, expression, verdict = args.settle
        chosen_subjects(args.dataset, [subject])
        index = read_index(args.dataset, subject)
        label = settlement(args.dataset, index, expression, verdict, args.annotator)
        label = append_label(args.dataset, label)
        words = f"{subject} {expression}: settled as {describe(label)} by {args.annotator}"
        return answer(args, asdict(label), words)
    queue = disagreements(
        args.dataset, args.beyond, args.all, chosen_subjects(args.dataset, args.subject)
    )
    lines = []
    for row in queue:
        said = ", ".join(f"{who} {what}" for who, what in row.said.items())
        settled = f" -> {row.settled}" if row.settled else ""
        lines.append(f"{row.subject} {row.expression}: {said}{settled}")
    done = sum(row.settled is not None for row in queue)
    words = f"{len(queue) - done} to review" + (f", {done} settled" if args.all else "")
    words += f" (marks at most {count(args.beyond, 'frame')} apart agree)"
    return answer(args, [asdict(row) for row in queue], *lines, words)


def run_coverage(args: argparse.Namespace) -> int:
    """Print the missing labels and the counts of the subjects' gender and age."""
    report = coverage(args.dataset)
    states = ("person", "rule", "auto", "flagged", "missing")
    rows = [
        {"subject": subject} | {state: list(cells.values()).count(state) for state in states}
        for subject, cells in report["cells"].items()
    ]
    lines = table(("subject", *states), rows)
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
    header = ("subject", "expressions", "by_person", "by_rule", "automatic", "flagged", "excluded")
    lines = table(header, subjects)
    rows = [{"annotator": who} | row for who, row in people.items()]
    if rows:
        lines += ["", *table(list(rows[0]), rows)]
    return answer(args, {"subjects": subjects, "annotators": people}, *lines)


def run_sheet(args: argparse.Namespace) -> int:
    """Write the page."""
    from annotations.sheet import make_sheet, render_sheet
    from annotations.ui.frames import FaceFinder
    from express50.files.atomic import write_bytes

    check_page_file(args.file)
    sheet = make_sheet(args.dataset, args.subject, args.expression, args.camera, args.sure)
    chosen = args.subject or args.expression
    around = args.around if args.around is not None else AROUND if chosen else 0
    faces = FaceFinder(args.dataset)
    log(f"{args.file}: drawing {count(len(sheet.tiles), 'label')}")
    faces.load()
    page = render_sheet(args.dataset, sheet, faces=faces, around=around).encode()
    write_bytes(args.file, page)
    counts = sheet.counts()
    said = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    data = {"file": str(args.file), "bytes": len(page), "tiles": counts}
    return answer(args, data, f"{args.file} ({len(page):,} bytes): {said}")


def run_reference(args: argparse.Namespace) -> int:
    """Print the reference, or make another subject it."""
    if args.subject is not None:
        choose_reference(args.dataset, args.subject)
    subject = reference_subject(args.dataset)
    return answer(args, {"reference": subject}, f"reference: {subject}")


def run_rule(args: argparse.Namespace) -> int:
    """Append the rule's marks; people's labels override them."""
    chosen = chosen_subjects(args.dataset, args.subject) or included_subjects(args.dataset)
    indexes = [read_index(args.dataset, subject) for subject in chosen]
    known = dict.fromkeys(cue.expression_id for index in indexes for cue in index.cues)
    check_known(str(args.dataset.root), "expression", args.expression or (), known)
    marks = [m for i in indexes for m in last_frame_marks(args.dataset, i, args.expression)]
    marks = [append_label(args.dataset, mark) for mark in marks]
    words = f"{count(len(marks), 'mark')} by {LAST_FRAME} in {count(len(chosen), 'subject')}"
    return answer(args, [asdict(mark) for mark in marks], words)


def run_exclusion(args: argparse.Namespace) -> int:
    """Append an exclusion, or include the subject again."""
    chosen_subjects(args.dataset, [args.subject])
    reason = args.reason.strip() if args.action == "exclude" else None
    if args.action == "include" and exclusion_reason(args.dataset, args.subject) is None:
        raise AnnotationError(f"{args.subject} is not excluded")
    event = Label(
        subject=args.subject, expression="", action=args.action, annotator=args.annotator,
        time=time.time(), reason=reason,
    )  # fmt: skip
    event = append_label(args.dataset, event)
    because = f": {event.reason}" if event.reason else ""
    lines = [f"{args.subject}: {args.action}d{because}"]
    try:
        if included_subjects(args.dataset):
            reference_subject(args.dataset)
    except AnnotationError as error:  # the reference person is excluded
        lines.append(str(error))
    return answer(args, asdict(event), *lines)


def run_export(args: argparse.Namespace) -> int:
    """Write the events."""
    check_results_file(args.file)
    stored = {subject: read_labels(args.dataset, subject) for subject in args.dataset.subjects()}
    chosen = chosen_subjects(args.dataset, args.subject) or [*stored]
    events = [label for subject in chosen for label in stored[subject]]
    export_labels(events, args.file, {label for labels in stored.values() for label in labels})
    words = f"{args.file}: {count(len(events), 'event')} of {count(len(chosen), 'subject')}"
    return answer(args, {"file": str(args.file), "events": len(events)}, words)


def run_import(args: argparse.Namespace) -> int:
    """Append the new events."""
    new, known = import_labels(args.dataset, args.file)
    data = {"file": str(args.file), "new": new, "known": known}
    words = f"{count(new, 'new event')}, {known} known already"
    if not new + known:
        words = "has no rows of events; nothing was imported"
    return answer(args, data, f"{args.file}: {words}")
