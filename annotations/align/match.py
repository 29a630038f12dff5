"""Suggestions for a subject's expressions: its own peaks, matched to the reference's frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from annotations.align.features import Features, expression_values, measure
from annotations.align.suggest import (
    Canonical,
    Suggestion,
    canonical_of,
    strongest_event,
    suggest,
    suggest_rest,
)
from annotations.observe.observations import NEUTRAL, SEEN_SCORE, FaceObservations
from annotations.observe.stage import steady
from express50.capture.expressions import Expression
from express50.capture.index import Index


@dataclass(frozen=True)
class Watched:
    """A subject's features by cue window.

    Attributes:
        subject: id.
        camera: that sees the face best.
        frames: (F,) observed frames.
        windows: expression id -> rows of ``frames`` in its cue window that show the face; none is
            empty.
        features: of those rows.
    """

    subject: str
    camera: str
    frames: np.ndarray
    windows: dict[str, np.ndarray]
    features: Features


@dataclass(frozen=True)
class Reference:
    """The reference identity, and the frames that people chose as canonical, by expression."""

    watched: Watched
    chosen: Mapping[str, int]
    flagged: frozenset[str] = frozenset()


def watch(index: Index, observations: FaceObservations) -> Watched:
    """Measure the features of a subject by cue window.

    Expressions whose window holds no observed frame that shows a face are left out.
    """
    windows = {}
    shown = observations.scores.max(axis=0) >= SEEN_SCORE
    for cue in index.cues:
        seen = (observations.frames >= cue.start_frame) & (observations.frames <= cue.end_frame)
        seen &= shown
        if seen.any():
            windows[cue.expression_id] = np.flatnonzero(seen)
    features = measure(observations, windows)
    return Watched(index.subject, observations.cameras[0], observations.frames, windows, features)


def suggest_all(
    subject: Watched, script: Mapping[str, Expression], reference: Reference | None
) -> tuple[dict[str, Suggestion], dict[str, int]]:
    """Suggest a frame of every expression; name the canonical frame it was matched to.

    Args:
        subject: the subject to suggest for.
        script: the known expressions; for others all of the face counts.
        reference: None where the subject is the reference, or it is not observed.
    """
    groups = subject.features.owner + 68 * subject.features.camera
    found, canonical = {}, {}
    for expression, rows in subject.windows.items():
        entry = script.get(expression)
        values = expression_values(subject.features, entry, rows)
        if expression == NEUTRAL:
            found[expression] = suggest_rest(values, groups, _typical(subject, entry))
            continue
        target = None
        if reference is not None and expression in reference.watched.windows:
            target = _target(subject.features, reference, expression, entry)
        if target is not None:
            canonical[expression] = target[0]
        found[expression] = suggest(values, groups, target[1] if target else None)
    return found, canonical


def _target(
    features: Features, reference: Reference, expression: str, entry: Expression | None
) -> tuple[int, Canonical] | None:
    """Express the reference's frame, chosen or else its apex, in the subject's features.

    Return None where people flagged the reference's performance.
    """
    if expression in reference.flagged:
        return None
    theirs = reference.watched
    rows = theirs.windows[expression]
    values = expression_values(theirs.features, entry, rows)
    if expression in reference.chosen:
        row = int(np.argmin(np.abs(theirs.frames[rows] - reference.chosen[expression])))
    else:
        row = strongest_event(values).apex
    frame = reference.chosen.get(expression, int(theirs.frames[rows[row]]))
    shared = shared_columns(features, theirs.features)
    return frame, canonical_of(values, row, shared, features.values.shape[1])


def shared_columns(features: Features, other: Features) -> np.ndarray:
    """Pair the columns (2, K) that measure the same on two subjects.

    Cameras of the same id are paired; where there are none, those that see each face best.
    """
    pairs = [(features.cameras.index(c), other.cameras.index(c)) for c in features.cameras
             if c in other.cameras] or [(0, 0)]  # fmt: skip
    return np.concatenate(
        [
            np.stack([np.flatnonzero(features.camera == a), np.flatnonzero(other.camera == b)])
            for a, b in pairs
        ],
        axis=1,
    )


def _typical(subject: Watched, entry: Expression | None) -> float:
    """Measure how far expressions usually move the face from rest, in units of noise."""
    tops = [
        np.linalg.norm(steady(expression_values(subject.features, entry, rows)), axis=1).max()
        for rows in subject.windows.values()
    ]
    return float(np.median(tops))
