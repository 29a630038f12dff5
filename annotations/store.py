"""The label store: one append-only file of events a subject, synced at every mark.

A label names a camera, a decode index, its pts and a perceptual hash, so that it can never point
at another frame unnoticed. Nothing is ever rewritten: undo is a record of its own, and a person's
label always stands above a suggestion that was accepted without one.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from express50 import __version__
from express50.errors import AnnotationError
from express50.index import Index
from express50.layout import Dataset

AUTOMATIC = "auto"
_ACTIONS = ("mark", "flag", "undo")


@dataclass(frozen=True, kw_only=True)
class Label:
    """One event of the store.

    Attributes:
        subject, expression: what is labelled.
        action: ``mark`` a peak, ``flag`` a failed performance, ``undo`` one's last event.
        annotator: who; ``auto`` for accepted suggestions.
        time: seconds since 1970.
        tool: version of this toolkit.
        frame, camera, pts, dhash: the frame's identity (absent for flag and undo).
        suggested: the frame that was suggested at that moment.
        confidence: of the suggestion, 0 to 1.
        reason: why it was flagged.
    """

    subject: str
    expression: str
    action: str
    annotator: str
    time: float
    tool: str = __version__
    frame: int | None = None
    camera: str | None = None
    pts: int | None = None
    dhash: str | None = None
    suggested: int | None = None
    confidence: float | None = None
    reason: str | None = None


def make_mark(
    index: Index,
    expression: str,
    frame: int,
    camera: str,
    annotator: str,
    suggested: int | None = None,
    confidence: float | None = None,
) -> Label:
    """A mark with the frame's full identity.

    Raises:
        AnnotationError: the expression is not in the cues, the camera not in the capture, or the
            frame outside the expression's cue window.
    """
    cue = next((c for c in index.cues if c.expression_id == expression), None)
    if cue is None:
        known = ", ".join(c.expression_id for c in index.cues)
        raise AnnotationError(
            f"{index.subject}: no expression {expression!r} in cues.csv ({known})"
        )
    source = index.cameras.get(camera)
    if source is None:
        known = ", ".join(index.cameras)
        raise AnnotationError(f"{index.subject}: no camera {camera!r}; expected one of {known}")
    if not cue.start_frame <= frame <= cue.end_frame or frame >= source.frames:
        raise AnnotationError(
            f"{index.subject} {expression}: frame {frame} lies outside the cue window"
            f" {cue.start_frame} to {min(cue.end_frame, source.frames - 1)}"
        )
    return Label(
        subject=index.subject,
        expression=expression,
        action="mark",
        annotator=annotator,
        time=time.time(),
        frame=frame,
        camera=camera,
        pts=source.pts[frame],
        dhash=source.dhash[frame],
        suggested=suggested,
        confidence=confidence,
    )


def append_label(dataset: Dataset, label: Label) -> None:
    """Append one event and sync it to disk; several annotators at once lose nothing.

    Raises:
        AnnotationError: the action is unknown.
    """
    if label.action not in _ACTIONS:
        raise AnnotationError(f"action {label.action!r}, expected one of {', '.join(_ACTIONS)}")
    path = dataset.labels_file(label.subject)
    path.parent.mkdir(parents=True, exist_ok=True)
    row = {k: v for k, v in asdict(label).items() if v is not None}
    line = (json.dumps(row, sort_keys=True) + "\n").encode()
    handle = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        if _ends_mid_line(handle):  # a writer died half-way: its rest must not swallow this line
            line = b"\n" + line
        os.write(handle, line)
        os.fsync(handle)
    finally:
        os.close(handle)


def _ends_mid_line(handle: int) -> bool:
    size = os.fstat(handle).st_size
    return size > 0 and os.pread(handle, 1, size - 1) != b"\n"


def read_labels(dataset: Dataset, subject: str) -> list[Label]:
    """All events of a subject in the order they were written; torn last lines are left out.

    Raises:
        AnnotationError: a whole line is not an event.
    """
    path = dataset.labels_file(subject)
    if not path.exists():
        return []
    lines = path.read_text().split("\n")
    return [
        label
        for number, line in enumerate(lines, 1)
        if line.strip() and (label := _parse(path, number, line)) is not None
    ]


def _parse(path: Path, number: int, line: str) -> Label | None:
    known = {f.name for f in fields(Label)}
    try:
        row = json.loads(line)
        return Label(**{k: v for k, v in row.items() if k in known})
    except json.JSONDecodeError:
        return None  # the torn end of a write that a crash cut short
    except (TypeError, AttributeError) as error:
        raise AnnotationError(f"{path}: line {number} is no label event ({error})") from None


def current_labels(labels: Iterable[Label]) -> dict[str, Label]:
    """The label in force for each expression: the last one by a person, else the automatic one."""
    stacks: dict[tuple[str, str], list[Label]] = {}
    for label in labels:
        stack = stacks.setdefault((label.expression, label.annotator), [])
        if label.action == "undo":
            if stack:
                stack.pop()
        else:
            stack.append(label)
    current: dict[str, Label] = {}
    for (expression, _), stack in stacks.items():
        if stack and _stands_above(stack[-1], current.get(expression)):
            current[expression] = stack[-1]
    return dict(sorted(current.items()))


def _stands_above(new: Label, old: Label | None) -> bool:
    if old is None:
        return True
    if (new.annotator == AUTOMATIC) != (old.annotator == AUTOMATIC):
        return old.annotator == AUTOMATIC
    return new.time >= old.time


def human_digest(dataset: Dataset, subject: str) -> str:
    """Digest of what people decided for a subject; automatic labels do not change it."""
    rows = [
        (label.expression, label.action, label.frame, label.camera, label.annotator, label.reason)
        for label in current_labels(read_labels(dataset, subject)).values()
        if label.annotator != AUTOMATIC
    ]
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()
