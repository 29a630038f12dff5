"""A label is one event, checked when it is made.

A label names a camera, a decode index, its pts and a perceptual hash, so that it can never point
at another frame unnoticed. An adjudication ranks highest, then people's labels, then a rule's, then
a suggestion accepted without a person.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import get_type_hints

from express50 import __version__
from express50.capture.index import CameraSource, Cue, Index
from express50.errors import AnnotationError

AUTOMATIC = "auto"
RULE_PREFIX = "rule:"
FLAG_REASONS = ("failed", "occluded", "not performed", "ambiguous")
EXCLUSION_ACTIONS = ("exclude", "include")  # of a whole subject; see contract.exclusions
ACTIONS = ("mark", "flag", "undo", "settle", *EXCLUSION_ACTIONS)


@dataclass(frozen=True, kw_only=True)
class Label:
    """One event of the store.

    Attributes:
        subject, expression: the labelled performance; no expression for a whole subject.
        action: ``mark`` a peak, ``flag`` a performance that has none, ``undo`` one's last event,
            ``settle`` a disagreement (with a frame, or with a reason in place of a flag),
            ``exclude`` or ``include`` a subject.
        annotator: who; ``auto`` for accepted suggestions, ``rule:...`` for rules.
        time: seconds since 1970.
        tool: version of this toolkit.
        frame, camera, pts, dhash: the frame's identity (absent for flag and undo).
        first, last: the plateau that the frame stands for, both inside, where it was given.
        suggested: the frame that was suggested at that moment.
        confidence: of the suggestion, 0 to 1.
        shown: whether the suggestion was visible before the decision.
        seconds, keys: time and keystrokes that the label took.
        reason: why it was flagged or excluded.
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
    first: int | None = None
    last: int | None = None
    suggested: int | None = None
    confidence: float | None = None
    shown: bool | None = None
    seconds: float | None = None
    keys: int | None = None
    reason: str | None = None


# What a field may be; a whole number does for one with a fraction.
KINDS = {
    name: int | float if kind is float else kind | int if kind == float | None else kind
    for name, kind in get_type_hints(Label).items()
}


def make_mark(index: Index, expression: str, frame: int, camera: str, annotator: str) -> Label:
    """Make a mark with the frame's full identity; ``replace`` adds what else is known.

    Raises:
        AnnotationError: the expression is not in the cues, the camera not in the capture, or the
            frame outside the expression's cue window.
    """
    cue = find_cue(index, expression)
    source = find_camera(index, camera)
    _check_frame(index, cue, source, frame)
    label = _event(index, expression, "mark", annotator)
    pts, dhash = source.pts[frame], source.dhash[frame]
    return replace(label, frame=frame, camera=camera, pts=pts, dhash=dhash)


def with_plateau(mark: Label, index: Index, first: int | None, last: int | None) -> Label:
    """Give a mark the plateau that its frame stands for; an end may be open.

    Raises:
        AnnotationError: an end lies outside the expression's cue window, or the frame outside the
            plateau.
    """
    cue, source = find_cue(index, mark.expression), find_camera(index, mark.camera or "")
    frame = mark.frame or 0
    low, high = frame if first is None else first, frame if last is None else last
    for end in (low, high):
        _check_frame(index, cue, source, end)
    if not low <= frame <= high:
        raise AnnotationError(
            f"{index.subject} {mark.expression}: frame {frame} lies outside its plateau {low} to"
            f" {high}"
        )
    return replace(mark, first=first, last=last)


def make_flag(index: Index, expression: str, reason: str, annotator: str) -> Label:
    """Make a flag: the expression has no peak, for a reason such as those of ``FLAG_REASONS``.

    Raises:
        AnnotationError: the expression is not in the cues, or the reason is empty.
    """
    if not reason.strip():
        raise AnnotationError(
            f"{index.subject} {expression}: a flag needs a reason: {', '.join(FLAG_REASONS)}, ..."
        )
    return replace(_event(index, expression, "flag", annotator), reason=reason.strip())


def make_undo(index: Index, expression: str, annotator: str) -> Label:
    """Make an undo of the annotator's last event on an expression.

    Raises:
        AnnotationError: the expression is not in the cues.
    """
    return _event(index, expression, "undo", annotator)


def _event(index: Index, expression: str, action: str, annotator: str) -> Label:
    find_cue(index, expression)
    return Label(
        subject=index.subject,
        expression=expression,
        action=action,
        annotator=annotator,
        time=time.time(),
    )


def find_cue(index: Index, expression: str) -> Cue:
    """Find the cue window of an expression.

    Raises:
        AnnotationError: it is not in the cues.
    """
    cue = next((c for c in index.cues if c.expression_id == expression), None)
    if cue is None:
        known = ", ".join(c.expression_id for c in index.cues)
        raise AnnotationError(
            f"{index.subject}: no expression {expression!r} in cues.csv ({known})"
        )
    return cue


def find_camera(index: Index, camera: str) -> CameraSource:
    """Find the footage of a camera.

    Raises:
        AnnotationError: the capture has no such camera.
    """
    if camera not in index.cameras:
        known = ", ".join(index.cameras)
        raise AnnotationError(f"{index.subject}: no camera {camera!r}; expected one of {known}")
    return index.cameras[camera]


def shows_labelled_frame(index: Index, label: Label) -> bool:
    """Return whether the footage still holds the very frame that was labelled."""
    source, frame = index.cameras.get(label.camera or ""), label.frame or 0
    if source is None or not 0 <= frame < source.frames:
        return False
    return source.dhash[frame] == label.dhash


def _check_frame(index: Index, cue: Cue, source: CameraSource, frame: int) -> None:
    last = min(cue.end_frame, source.frames - 1)
    if not cue.start_frame <= frame <= last:
        raise AnnotationError(
            f"{index.subject} {cue.expression_id}: frame {frame} lies outside the cue window"
            f" {cue.start_frame} to {last}"
        )


def check_texts(label: Label) -> None:
    """Refuse texts that would break tables, or colour terminals.

    Raises:
        AnnotationError: the annotator's name or the reason is not one line of text.
    """
    for name in ("annotator", "reason"):
        if not (getattr(label, name) or "").isprintable():
            raise AnnotationError(
                f"{label.subject} {label.expression}: {name} {getattr(label, name)!r} has line"
                " breaks or control characters; expected one line of text"
            )
