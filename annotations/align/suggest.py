"""Suggest the frame of a clip that matches the reference's, or else its apex.

All curves are projections of a face's features (``features.py``) on one direction, found from the
clip itself. Frames that show the expression define the direction, which in turn ranks the frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from annotations.align.features import Features, expression_values, shared_columns
from annotations.observe.stage import steady
from express50.capture.expressions import NEUTRAL, Expression

CANDIDATES, CANDIDATE_GAP = 5, 3
NEAR_FRAMES = 2.0  # an event's direction is learnt from frames about its apex (sigma)
OVERRULE = 2.0  # an event this much more like the reference's replaces the strongest one,
OVERRULE_COSINE = 0.3  # if it moves in that direction at all: noise is unlike it
DISPUTED = 0.6  # factor on the confidence if the strongest event is not the most similar one
APEX_LEVEL = 0.9  # a canonical frame at this share of its apex or more counts as the apex
OTHER_SIDE = 0.05  # of the apex: what being on the other side of it counts
PLATEAU_SHARE = 0.95  # of the apex: frames that are equal to it within noise
AGREE_FRAMES = 1
STILL = 1.0  # in units of one feature's noise: a face that moves less is at rest
LARGEST_FEATURE = 1e100  # in units of its noise; the square of more may not be finite
_DRAWS = 24  # random halves of the features that a suggestion is repeated with


@dataclass(frozen=True)
class Event:
    """One movement of a clip: the row of its apex, its progress (T,) by frame, its direction."""

    apex: int
    curve: np.ndarray
    direction: np.ndarray


@dataclass(frozen=True)
class Canonical:
    """The reference's canonical frame, in the subject's features."""

    direction: np.ndarray  # (N,) unit vector of the movement; 0 where the reference lacks a feature
    level: float  # how far the movement was done in that frame, as a share of its apex
    side: int  # -1 before the apex, 1 after it, 0 at it


@dataclass(frozen=True)
class Suggestion:
    """A suggested frame."""

    row: int  # of the clip
    # share of random halves of the features that agree within a frame; lowered if the clip's
    # strongest movement is not the one most like the reference's
    confidence: float
    activity: np.ndarray  # (T,) how far the face is from rest, in units of noise
    match: np.ndarray | None  # (T,) likeness to the canonical frame, 0 to 1; None without one
    candidates: list[int]  # rows worth a look, best first


@dataclass(frozen=True)
class Reference:
    """The reference's expressions that nobody flagged, and the frames that people chose."""

    features: Features
    chosen: Mapping[str, int]


def suggest_all(
    features: Features, script: Mapping[str, Expression], reference: Reference | None
) -> tuple[dict[str, Suggestion], dict[str, int]]:
    """Suggest a frame of every expression; name the canonical frame it was matched to.

    For expressions that `script` does not know, all of the face counts. `reference` is None where
    the subject is the reference, or where that is not observed.
    """
    groups = features.owner + 68 * features.camera
    found, canonical = {}, {}
    for expression, rows in features.windows.items():
        entry = script.get(expression)
        values = expression_values(features, entry, rows)
        if expression == NEUTRAL:
            tops = [  # how far expressions usually move the face from rest, in units of noise
                distance_from_rest(expression_values(features, entry, window)).max()
                for window in features.windows.values()
            ]
            found[expression] = suggest_rest(values, groups, float(np.median(tops)))
            continue
        target = None
        if reference is not None and expression in reference.features.windows:
            canonical[expression], target = _target(features, reference, expression, entry)
        found[expression] = suggest(values, groups, target)
    return found, canonical


def _target(
    features: Features, reference: Reference, expression: str, entry: Expression | None
) -> tuple[int, Canonical]:
    """Express the reference's frame, chosen or else its apex, in the subject's features."""
    theirs = reference.features
    rows = theirs.windows[expression]
    values = expression_values(theirs, entry, rows)
    if expression in reference.chosen:
        row = int(np.argmin(np.abs(theirs.frames[rows] - reference.chosen[expression])))
    else:
        row = strongest_event(values).apex
    frame = reference.chosen.get(expression, int(theirs.frames[rows[row]]))
    shared = shared_columns(features, theirs)
    return frame, canonical_of(values, row, shared, features.values.shape[1])


def suggest(values: np.ndarray, groups: np.ndarray, canonical: Canonical | None) -> Suggestion:
    """Suggest the frame of a clip that matches the canonical one, or else its apex.

    `values` (T, N) are those of ``expression_values``, 0 at rest. Features of one of the `groups`
    (N,) go to the same half when halves are drawn. `canonical` is None for the reference itself.

    Raises:
        ValueError: the clip is empty or not finite.
    """
    _check(values)
    own = strongest_event(values)
    event, certain = choose_event(values, own, canonical)
    row = matching_row(event, canonical)
    rows = []
    for kept in _halves(groups):
        half, part = None, values[:, kept]
        if canonical is not None:
            half = replace(canonical, direction=_unit(canonical.direction[kept]))
        rows.append(matching_row(choose_event(part, strongest_event(part), half)[0], half))
    agreeing = sum(abs(other - row) <= AGREE_FRAMES for other in rows)
    match = None
    if canonical is not None:
        match = np.clip(1.0 - np.abs(share_of_apex(event) - canonical.level), 0.0, 1.0)
    confidence = agreeing / (len(rows) + 1) * (1.0 if certain else DISPUTED)
    return Suggestion(
        row, confidence if own.curve.max() > STILL else 0.0, own.curve, match,
        candidate_rows(row, [event.apex, own.apex], own.curve),
    )  # fmt: skip


def suggest_rest(values: np.ndarray, groups: np.ndarray, typical: float) -> Suggestion:
    """Suggest the calmest frame of a clip at rest; any frame that is as calm is as good.

    `values` (T, N) are 0 at the middle of the clip; `groups` are as for :func:`suggest`. `typical`
    is the activity of other expressions at their apex, in the same units.

    Raises:
        ValueError: the clip is empty or not finite.
    """
    _check(values)
    level = distance_from_rest(values)
    row = int(np.argmin(level))
    enough = level[row] + 0.1 * typical
    good = [
        level[np.argmin(distance_from_rest(values[:, kept]))] <= enough for kept in _halves(groups)
    ]
    return Suggestion(
        row, sum(good) / (len(good) + 1), level, None, candidate_rows(row, [], -level)
    )


def _check(values: np.ndarray) -> None:
    if values.size == 0 or not np.abs(values).max() < LARGEST_FEATURE:
        raise ValueError(
            f"features are {values.shape}, expected at least one frame, all finite and below"
            f" {LARGEST_FEATURE:g}"
        )


def _halves(groups: np.ndarray) -> Iterator[np.ndarray]:
    """Draw random halves (N,) bool of the features, always the same, so that reruns agree."""
    rng, names = np.random.default_rng(0), np.unique(groups)
    for _ in range(_DRAWS):
        kept = np.isin(groups, names[rng.random(len(names)) < 0.5])
        if kept.any():
            yield kept


def distance_from_rest(values: np.ndarray) -> np.ndarray:
    """Measure the distance (T,) of features (T, N) from rest, averaged over neighbouring frames."""
    return np.linalg.norm(steady(values), axis=1)


def strongest_event(values: np.ndarray) -> Event:
    """Find the strongest movement of a clip (T, N): power iteration from the frames' energies."""
    curve, direction = _iterate_direction(values, (values**2).sum(1), np.ones(len(values)), 8)
    even = steady(curve)
    top = int(np.argmax(even))
    lower = np.flatnonzero(even < PLATEAU_SHARE * even[top])
    low = lower[lower < top].max(initial=-1) + 1
    high = lower[lower > top].min(initial=len(even)) - 1
    # The apex is the middle of the frames that equal the top within noise.
    return Event(round(float(low + high) / 2), curve, direction)


def most_similar_event(values: np.ndarray, direction: np.ndarray) -> tuple[Event, np.ndarray]:
    """Find the movement most similar to a direction (N,), and each frame's similarity (T,) to it.

    Similarity is how far a frame moves in the direction, times the cosine between the two.
    """
    shared = direction != 0
    calm = steady(values[:, shared])
    along = np.maximum(calm @ direction[shared], 0.0)
    likeness = steady(along**2 / np.maximum(np.linalg.norm(calm, axis=1), 1e-12))
    return _event_about(values, likeness, int(np.argmax(likeness))), likeness


def choose_event(values: np.ndarray, own: Event, canonical: Canonical | None) -> tuple[Event, bool]:
    """Choose the strongest event, unless another is clearly more like the reference's.

    The second value is False where the two differ.
    """
    if canonical is None or not canonical.direction.any():
        return own, True
    other, likeness = most_similar_event(values, canonical.direction)
    if abs(other.apex - own.apex) <= AGREE_FRAMES:
        return own, True
    if likeness[other.apex] <= OVERRULE * likeness[own.apex]:
        return own, False
    shared = np.linalg.norm(other.direction[canonical.direction != 0])
    cosine = float(other.direction @ canonical.direction) / max(float(shared), 1e-12)
    return (other if cosine > OVERRULE_COSINE else own), False


def matching_row(event: Event, canonical: Canonical | None) -> int:
    """Find the matching row: the apex, or the same share of it as in the canonical frame.

    The row lies on the canonical frame's side of the apex if both sides offer one.
    """
    if canonical is None or canonical.side == 0:
        return event.apex
    share = share_of_apex(event)
    rows = np.concatenate([_slope(share, event.apex, -1), _slope(share, event.apex, 1)])
    away = np.abs(share[rows] - canonical.level)
    away += OTHER_SIDE * (np.sign(rows - event.apex) == -canonical.side)
    return int(rows[np.argmin(away)])


def share_of_apex(event: Event) -> np.ndarray:
    """Return the progress of an event in each frame (T,), as a share of its apex."""
    return event.curve / max(float(steady(event.curve)[event.apex]), 1e-12)


def _slope(share: np.ndarray, apex: int, side: int) -> np.ndarray:
    """List rows from the apex to one side while the movement falls, apart from small tremors."""
    rows = [apex]
    while 0 <= rows[-1] + side < len(share) and share[rows[-1] + side] <= share[rows[-1]] + 0.05:
        rows.append(rows[-1] + side)
    return np.array(rows)


def canonical_of(values: np.ndarray, row: int, shared: np.ndarray, count: int) -> Canonical:
    """Express a row of the reference's clip, values (T, M), as the canonical frame.

    `shared` (2, K) are columns of the subject's features and those of the reference's, in pairs;
    the subject has `count` features.
    """
    event = strongest_event(values)
    share = share_of_apex(event)
    if row not in (*_slope(share, event.apex, -1), *_slope(share, event.apex, 1)):
        event = _event_about(values, np.linalg.norm(values, axis=1), row)
        share = share_of_apex(event)
    direction = np.zeros(count)
    direction[shared[0]] = event.direction[shared[1]]
    direction = _unit(direction)
    level = float(np.clip(share[row], 0.0, 1.0))
    return Canonical(direction, level, 0 if level >= APEX_LEVEL else int(np.sign(row - event.apex)))


def _event_about(values: np.ndarray, weights: np.ndarray, row: int) -> Event:
    """Find the event that a row belongs to; frames about the row give its direction."""
    near = np.exp(-0.5 * ((np.arange(len(values)) - row) / NEAR_FRAMES) ** 2)
    curve, direction = _iterate_direction(values, near * weights, near, 3)
    even = steady(curve)
    while True:  # climb to the local maximum
        low = max(0, row - 1)
        best = low + int(np.argmax(even[low : row + 2]))
        if even[best] <= even[row]:
            return Event(row, curve, direction)
        row = best


def candidate_rows(row: int, others: list[int], curve: np.ndarray) -> list[int]:
    """List rows worth a look, best first: the suggestion, other events, the curve's maxima.

    At most CANDIDATES, at least CANDIDATE_GAP frames apart.
    """
    padded = np.pad(curve, 1, constant_values=-np.inf)
    peaks = np.flatnonzero((curve >= padded[:-2]) & (curve >= padded[2:]))
    ranked = [*others, *(int(k) for k in peaks[np.argsort(-curve[peaks], kind="stable")])]
    chosen = [row]
    for other in ranked:
        if len(chosen) < CANDIDATES and all(abs(other - c) >= CANDIDATE_GAP for c in chosen):
            chosen.append(other)
    return chosen


def _iterate_direction(
    values: np.ndarray, weights: np.ndarray, near: np.ndarray, rounds: int
) -> tuple[np.ndarray, np.ndarray]:
    """Alternate between a unit direction (N,) and the curve (T,) of progress along it."""
    curve, direction = weights, np.zeros(values.shape[1])
    for _ in range(rounds):
        direction = _unit((near * curve) @ values)
        curve = np.maximum(values @ direction, 0.0)
    return curve, direction


def _unit(direction: np.ndarray) -> np.ndarray:
    return direction / max(float(np.linalg.norm(direction)), 1e-12)
