"""Make labels, each a checked event, and append them to a subject's file.

A label names a camera, a decode index, its pts and a perceptual hash, so that it can never point
at another frame unnoticed. An adjudication ranks highest, then people's labels, then a rule's, then
an automatically accepted suggestion. Nothing is ever rewritten: undo is an event of its own.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import MISSING, asdict, dataclass, fields, replace
from typing import get_type_hints

from express50 import __version__
from express50.capture.index import Cue, Index, same_hash
from express50.contract.layout import Dataset
from express50.errors import AnnotationError, UnknownNameError, check_known
from express50.files.atomic import lock_file, sync_directory
from express50.files.digests import text_digest
from express50.files.text import parse_json, read_bytes

AUTOMATIC = "auto"
RULE_PREFIX = "rule:"
FLAG_REASONS = ("failed", "occluded", "not performed", "ambiguous")
EXCLUSION_ACTIONS = ("exclude", "include")  # actions on a whole subject; see contract.layout
ACTIONS = ("mark", "flag", "undo", "settle", *EXCLUSION_ACTIONS)


@dataclass(frozen=True, kw_only=True)
class Label:
    """One event of the store."""

    subject: str
    expression: str  # empty for a whole subject
    action: str  # one of ``ACTIONS``; a settlement has a frame, or the reason for a flag
    annotator: str  # the person's name; ``auto`` for accepted suggestions, ``rule:...`` for rules
    time: float  # seconds since 1970
    tool: str = __version__  # version of this toolkit
    # frame, camera, pts and dhash identify the frame; flag and undo have none
    frame: int | None = None
    camera: str | None = None
    pts: int | None = None
    dhash: str | None = None
    first: int | None = None  # of the plateau around the frame, if it was given
    last: int | None = None  # of the plateau, inclusive
    suggested: int | None = None  # the frame suggested at that moment
    confidence: float | None = None  # of the suggestion, 0 to 1
    shown: bool | None = None  # whether the suggestion was visible before the decision
    seconds: float | None = None  # that the label took
    keys: int | None = None  # keystrokes that the label took
    reason: str | None = None  # why it was flagged or excluded


# Types of the fields; an integer is accepted where a float is expected.
KINDS = {
    name: int | float if kind is float else kind | int if kind == float | None else kind
    for name, kind in get_type_hints(Label).items()
}
REQUIRED = [field.name for field in fields(Label) if field.default is MISSING]
MEND = "correct or remove the line"


def make_mark(
    index: Index,
    expression: str,
    frame: int,
    camera: str,
    annotator: str,
    first: int | None = None,
    last: int | None = None,
) -> Label:
    """Make a mark with the frame's full identity and, where given, ends of its plateau.

    Raises:
        AnnotationError: the expression is not in the cues, the camera not in the capture, a frame
            outside the expression's cue window, or the frame outside its plateau.
    """
    cue = find_cue(index, expression)
    check_known(index.subject, "camera", [camera], index.cameras)
    source = index.cameras[camera]
    end = min(cue.end_frame, source.frames - 1)
    low, high = cue.start_frame if first is None else first, end if last is None else last
    window, plateau = f"{cue.start_frame} to {end}", f"{low} to {high}"
    for fits, what in (
        (cue.start_frame <= frame <= end,
         f"frame {frame} is outside its cue window; expected {window}"),
        (low <= frame <= high,
         f"frame {frame} is outside its plateau, {plateau}; move the mark or the plateau's ends"),
        (cue.start_frame <= low <= high <= end,
         f"plateau {plateau} leaves the cue window; expected {window} or less"),
    ):  # fmt: skip
        if not fits:
            raise AnnotationError(f"{index.subject} {expression}: {what}")
    return replace(
        make_event(index, expression, "mark", annotator),
        frame=frame,
        camera=camera,
        pts=source.pts[frame],
        dhash=source.dhash[frame],
        first=first,
        last=last,
    )


def make_flag(index: Index, expression: str, reason: str, annotator: str) -> Label:
    """Make a flag: the expression has no peak, for a reason such as those of ``FLAG_REASONS``.

    Raises:
        AnnotationError: the expression is not in the cues, or the reason is empty.
    """
    if not reason.strip():
        raise AnnotationError(
            f"{index.subject} {expression}: a flag needs a reason: {', '.join(FLAG_REASONS)}, ..."
        )
    return replace(make_event(index, expression, "flag", annotator), reason=reason.strip())


def make_event(index: Index, expression: str, action: str, annotator: str) -> Label:
    """Make an event that names no frame, such as an undo.

    Raises:
        UnknownNameError: the expression is not in the cues.
    """
    find_cue(index, expression)
    return Label(
        subject=index.subject,
        expression=expression,
        action=action,
        annotator=annotator,
        time=time.time(),
    )


def find_cue(index: Index, expression: str) -> Cue:
    """Find the cue window of an expression; UnknownNameError if it is not in the cues."""
    cues = {cue.expression_id: cue for cue in index.cues}
    check_known(index.subject, "expression", [expression], cues)
    return cues[expression]


def footage_problems(index: Index, label: Label) -> Iterator[tuple[str, str]]:
    """Compare one event with the footage; return kind and description of each problem."""
    if not label.expression:  # about the whole subject
        return
    try:
        cue = find_cue(index, label.expression)
    except UnknownNameError as error:  # cues.csv no longer names it
        yield "unknown", str(error)
        return
    if label.frame is None:
        return
    source = index.cameras.get(label.camera or "")
    if source is None:
        yield "unknown", f"no camera {label.camera!r} in the footage"
        return
    for name in ("first", "frame", "last"):
        frame = getattr(label, name)
        if frame is not None and not cue.start_frame <= frame <= cue.end_frame:
            window = f"{cue.start_frame} to {cue.end_frame}"
            yield "window", f"{name} {frame} lies outside the cue window {window}"
    if not 0 <= label.frame < source.frames:
        yield "identity", f"{label.camera} has {source.frames} frames, and no frame {label.frame}"
        return
    pts, dhash = source.pts[label.frame], source.dhash[label.frame]
    if pts != label.pts or not same_hash(dhash, label.dhash):
        found = f"frame {label.frame} of {label.camera} has pts {pts} and hash {dhash}"
        yield "identity", f"{found}, the label says {label.pts} and {label.dhash}"


def lost_frame(index: Index, label: Label) -> str:
    """Return why a label's frame is not in the footage; an empty text if it is, or has none."""
    return next((what for kind, what in footage_problems(index, label) if kind != "window"), "")


def check_texts(label: Label) -> None:
    """Refuse texts that would break tables or control the terminal.

    Raises:
        AnnotationError: the annotator's name or the reason is not one line of text.
    """
    for name in ("annotator", "reason"):
        if not (getattr(label, name) or "").isprintable():
            raise AnnotationError(
                f"{label.subject} {label.expression}: {name} {getattr(label, name)!r} has line"
                " breaks or control characters; expected one line of text"
            )


def append_label(dataset: Dataset, label: Label, imported: bool = False) -> Label:
    """Append one event and sync it to disk; several annotators at once lose nothing.

    Unless it is `imported`, it counts after all that was said before, even if this machine's clock
    is behind: the event that is returned then has a later time.

    Raises:
        AnnotationError: a text is not one line, or a line of the file is not an event.
        OSError: it could not be written; it is then missing, or a torn line that readers skip.
    """
    check_texts(label)
    path = dataset.labels_file(label.subject)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o666)
    try:
        lock_file(handle, path)
        before = [] if imported else read_labels(dataset, label.subject)
        times = [
            math.nextafter(x.time, math.inf) for x in before if x.expression == label.expression
        ]
        label = replace(label, time=max([label.time, *times]))
        row = {k: v for k, v in asdict(label).items() if v is not None}
        line = (json.dumps(row, sort_keys=True) + "\n").encode()
        size = os.fstat(handle).st_size
        if size and os.pread(handle, 1, size - 1) != b"\n":
            line = b"\n" + line  # a writer died half-way: its torn line must not absorb this one
        while line:  # a signal or a nearly full disk may cut one write short
            line = line[os.write(handle, line) :]
        os.fsync(handle)
    finally:
        os.close(handle)
    if size == 0:  # the file's name must outlive a power cut too
        sync_directory(path.parent)
    return label


def read_labels(dataset: Dataset, subject: str) -> list[Label]:
    """Read all events of a subject in the order they were written; torn last lines are left out.

    Raises:
        AnnotationError: a whole line is not an event.
    """
    return [label for _, label in _lines(dataset, subject) if label is not None]


def unreadable_lines(dataset: Dataset, subject: str) -> list[int]:
    """List the lines, from 1, that `read_labels` passes over because a crash cut them short."""
    return [number for number, label in _lines(dataset, subject) if label is None]


def _lines(dataset: Dataset, subject: str) -> Iterator[tuple[int, Label | None]]:
    """Yield numbers and events of a subject's lines; None if a line cannot be read."""
    path = dataset.labels_file(subject)
    if not path.exists():
        return
    data = read_bytes(path, AnnotationError, fix="restore it")
    for number, line in enumerate(data.decode("utf-8", errors="replace").split("\n"), 1):
        if not line.strip():
            continue
        where = f"{path}: line {number}"
        try:
            row = parse_json(line, where, AnnotationError, MEND)
        except AnnotationError:
            if line.rstrip().endswith("}"):  # somebody edited it
                raise
            yield number, None  # a crash cut it short
            continue
        if not isinstance(row, dict):
            raise AnnotationError(f"{where}: {line[:60]!r} is not a label event; {MEND}")
        if missing := [name for name in REQUIRED if name not in row]:
            raise AnnotationError(f"{where}: has no {' and no '.join(missing)}; {MEND}")
        label = Label(**{k: v for k, v in row.items() if k in KINDS})
        for name, kind in KINDS.items():
            if not isinstance(found := getattr(label, name), kind):
                raise AnnotationError(f"{where}: {name} is {found!r}, not {kind}; {MEND}")
        check_known(where, "action", [label.action], ACTIONS, AnnotationError)
        if label.action == "mark" and label.frame is None:
            raise AnnotationError(f"{where}: a mark needs a frame; {MEND}")
        yield number, label


def current_labels(labels: Iterable[Label]) -> dict[str, Label]:
    """Return the label in force for each expression: the latest of the highest rank."""
    events = [label for stack in _stacks(labels).values() for label in stack]
    events.sort(key=lambda label: (label.expression, _rank(label), label.time))
    return {label.expression: label for label in events}  # the last one wins


def overruling(labels: Iterable[Label], label: Label) -> Label | None:
    """Return the settlement that stays in force whatever a label says; None without one."""
    force = current_labels(labels).get(label.expression)
    return force if force is not None and _rank(force) > _rank(label) else None


def latest_labels(labels: Iterable[Label]) -> list[Label]:
    """Return each annotator's latest label of each expression; those undone are left out."""
    return [stack[-1] for stack in _stacks(labels).values() if stack]


def labels_of(labels: Iterable[Label], annotator: str) -> dict[str, Label]:
    """Return one annotator's labels by expression; their adjudications of others are left out."""
    own = {
        expression: said[-1]
        for (expression, who), stack in _stacks(labels).items()
        if who == annotator and (said := [x for x in stack if x.action != "settle"])
    }
    return dict(sorted(own.items()))


def last_event(labels: Iterable[Label], expression: str, annotator: str) -> Label | None:
    """Return the event that an undo would take back; None if nothing of theirs is left."""
    stack = _stacks(labels).get((expression, annotator))
    return stack[-1] if stack else None


def _stacks(labels: Iterable[Label]) -> dict[tuple[str, str], list[Label]]:
    """Stack the events that were not undone, by expression and annotator, the latest last.

    An import may have put an older event below newer ones.
    """
    stacks: dict[tuple[str, str], list[Label]] = {}
    for label in sorted(labels, key=lambda label: label.time):
        if label.action in EXCLUSION_ACTIONS:
            continue
        stack = stacks.setdefault((label.expression, label.annotator), [])
        if label.action != "undo":
            stack.append(label)
        elif stack:
            stack.pop()
    return stacks


def _rank(label: Label) -> int:
    """Rank an annotator: adjudications, then people, then rules, then suggestions."""
    if label.action == "settle":
        return 3
    return 2 if is_person(label.annotator) else int(label.annotator != AUTOMATIC)


def is_person(annotator: str) -> bool:
    """Return whether a name is a person's: neither the align stage's nor a rule's."""
    return annotator != AUTOMATIC and not annotator.startswith(RULE_PREFIX)


def origin(label: Label) -> str:
    """Return who gave a label: ``person``, ``rule`` or ``auto``; ``flagged`` if it has no frame."""
    if label.frame is None:
        return "flagged"
    if label.annotator == AUTOMATIC:
        return "auto"
    return "person" if is_person(label.annotator) else "rule"


def voices(labels: Sequence[Label]) -> dict[str, dict[str, Label]]:
    """Return the labels in force of people, by expression and then by name, sorted."""
    found: dict[str, dict[str, Label]] = {}
    for who in sorted({label.annotator for label in labels if is_person(label.annotator)}):
        for expression, label in labels_of(labels, who).items():
            found.setdefault(expression, {})[who] = label
    return found


def human_digest(dataset: Dataset, subject: str) -> str:
    """Digest the decisions of people and rules; automatic labels do not change the digest."""
    rows = [
        (label.expression, label.action, label.frame, label.camera, label.annotator, label.reason)
        for label in current_labels(read_labels(dataset, subject)).values()
        if label.annotator != AUTOMATIC
    ]
    return text_digest(json.dumps(rows))
