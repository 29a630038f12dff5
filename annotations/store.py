"""The label store: one append-only file of events per subject, synced at every mark.

Nothing is ever rewritten: undo is a record of its own.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from annotations.labels import (
    ACTIONS,
    AUTOMATIC,
    EXCLUSION_ACTIONS,
    KINDS,
    RULE_PREFIX,
    Label,
    check_texts,
)
from express50.contract.layout import Dataset
from express50.errors import AnnotationError
from express50.files.atomic import sync_directory
from express50.files.text import parse_json, read_bytes


def append_label(dataset: Dataset, label: Label) -> None:
    """Append one event and sync it to disk; several annotators at once lose nothing.

    Raises:
        AnnotationError: the action is unknown, or a text is not one line.
        OSError: it could not be written; then it is missing, or a torn line that readers pass over.
    """
    if label.action not in ACTIONS:
        raise AnnotationError(f"action {label.action!r}, expected one of {', '.join(ACTIONS)}")
    check_texts(label)
    path = dataset.labels_file(label.subject)
    path.parent.mkdir(parents=True, exist_ok=True)
    row = {k: v for k, v in asdict(label).items() if v is not None}
    line = (json.dumps(row, sort_keys=True) + "\n").encode()
    handle = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
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
    """Yield numbers and events of a subject's lines; None where a line cannot be read."""
    path = dataset.labels_file(subject)
    if not path.exists():
        return
    data = read_bytes(path, AnnotationError, fix="restore it")
    for number, line in enumerate(data.decode("utf-8", errors="replace").split("\n"), 1):
        if line.strip():
            yield number, _parse(path, number, line)


def _parse(path: Path, number: int, line: str) -> Label | None:
    try:
        row = parse_json(line, str(path), AnnotationError)
    except AnnotationError:
        return None  # the torn end of a write that a crash cut short
    try:
        label = Label(**{k: v for k, v in row.items() if k in KINDS})
    except (TypeError, AttributeError) as error:
        raise AnnotationError(f"{path}: line {number} is not a label event ({error})") from None
    for name, kind in KINDS.items():
        if not isinstance(getattr(label, name), kind):
            raise AnnotationError(
                f"{path}: line {number}: {name} is {getattr(label, name)!r}, expected {kind}; "
                "remove the line"
            )
    return label


def current_labels(labels: Iterable[Label]) -> dict[str, Label]:
    """Return the label in force for each expression: the last of those that rank highest."""
    current: dict[str, Label] = {}
    for (expression, _), stack in _stacks(labels).items():
        for label in stack:
            old = current.get(expression)
            if old is None or (_rank(label), label.time) >= (_rank(old), old.time):
                current[expression] = label
    return dict(sorted(current.items()))


def labels_of(labels: Iterable[Label], annotator: str) -> dict[str, Label]:
    """Return one annotator's labels by expression; their adjudications of others are left out."""
    own = {
        expression: said[-1]
        for (expression, who), stack in _stacks(labels).items()
        if who == annotator and (said := [x for x in stack if x.action != "settle"])
    }
    return dict(sorted(own.items()))


def last_event(labels: Iterable[Label], expression: str, annotator: str) -> Label | None:
    """Return the event that an undo would take back; None where nothing of theirs is left."""
    stack = _stacks(labels).get((expression, annotator))
    return stack[-1] if stack else None


def _stacks(labels: Iterable[Label]) -> dict[tuple[str, str], list[Label]]:
    """Stack the events that were not undone, by expression and annotator."""
    stacks: dict[tuple[str, str], list[Label]] = {}
    for label in labels:
        if label.action in EXCLUSION_ACTIONS:
            continue
        stack = stacks.setdefault((label.expression, label.annotator), [])
        if label.action != "undo":
            stack.append(label)
        elif stack:
            stack.pop()
    return stacks


def _rank(label: Label) -> int:
    """Adjudications stand above people, people above rules, rules above suggestions."""
    if label.action == "settle":
        return 3
    if label.annotator.startswith(RULE_PREFIX):
        return 1
    return 0 if label.annotator == AUTOMATIC else 2


def is_person(annotator: str) -> bool:
    """Return whether a name is a person's: neither the align stage's nor a rule's."""
    return annotator != AUTOMATIC and not annotator.startswith(RULE_PREFIX)


def labels_by_person(labels: Sequence[Label]) -> dict[str, dict[str, Label]]:
    """Return each person's labels by expression, in the order of their names."""
    people = sorted({label.annotator for label in labels if is_person(label.annotator)})
    return {who: labels_of(labels, who) for who in people}


def human_digest(dataset: Dataset, subject: str) -> str:
    """Digest the decisions of people and rules; automatic labels do not change the digest."""
    rows = [
        (label.expression, label.action, label.frame, label.camera, label.annotator, label.reason)
        for label in current_labels(read_labels(dataset, subject)).values()
        if label.annotator != AUTOMATIC
    ]
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()
