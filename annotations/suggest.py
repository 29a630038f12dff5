"""Where in its cue window an expression peaks: activity against the subject's own neutral.

Two measures are taken per frame and camera and scaled by their own noise in the neutral clip, so
that whichever sees the expression better decides: how far the landmarks moved (only those that the
script says take part, so that a blink does not pass for a smile), and how much the face looks
different once it is aligned to the neutral one (a tongue or a gaze moves no landmark).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from express50.expressions import Expression
from express50.transforms import similarity_fit

# iBUG-68 points that expressions move least: the nose's bridge and the corners of the eyes.
STABLE = np.array([27, 28, 29, 30, 36, 39, 42, 45])
LIDS = np.array([37, 38, 40, 41, 43, 44, 46, 47])
_GROUPS = {
    "brow": np.arange(17, 27),
    "eye": LIDS,
    "nose": np.arange(31, 36),
    "mouth": np.concatenate([np.arange(48, 68), np.arange(5, 12)]),
}
_CONTROL_GROUPS = {
    "brow": ("brow",),
    "eye": ("eye",),
    "nose": ("nose", "brow"),
    "nostril": ("nose",),
    "cheek": ("mouth",),
}
CROP = 48  # side of the aligned face, pixels
CANDIDATES, CANDIDATE_GAP = 5, 3
_LANDMARK_FLOOR = 0.004  # of the face's size: what a still face moves by in the detector's eyes
_LOOK_FLOOR = 0.01  # grey levels of 1: sensor noise after averaging


@dataclass(frozen=True)
class ClipObservation:
    """What one camera saw of one subject, over T frames.

    Attributes:
        points: (T, 68, 2) landmarks, pixels.
        scores: (T,) how surely a face was seen, 0 to 1.
        crops: (T, CROP, CROP) float32 grey face aligned to the neutral landmarks.
    """

    points: np.ndarray
    scores: np.ndarray
    crops: np.ndarray


@dataclass(frozen=True)
class Suggestion:
    """A suggested peak: frame (absolute), confidence 0 to 1, and the activity curve (T,)."""

    frame: int
    confidence: float
    activity: np.ndarray


def landmark_weights(expression: Expression | None) -> np.ndarray:
    """Weights (68,) of the points that take part in an expression; all when it is unknown."""
    weights = np.zeros(68)
    if expression is None:
        weights[17:] = 1.0
        weights[LIDS] = 0.5
        return weights
    names = [name for name, value in expression.controls.items() if abs(value) > 0.05]
    for name in names:
        prefix = next((p for p in _CONTROL_GROUPS if name.startswith(p)), "")
        for group in _CONTROL_GROUPS.get(prefix, ("mouth",)):
            weights[_GROUPS[group]] = 1.0
    if np.abs(expression.jaw).max() > 0.02:
        weights[_GROUPS["mouth"]] = 1.0
    if not weights.any():
        weights[17:] = 1.0
        weights[LIDS] = 0.5
    return weights


def align_crop(image: np.ndarray, points: np.ndarray, neutral: np.ndarray) -> np.ndarray:
    """The face (CROP, CROP) float32 grey of ``image``, moved onto the neutral landmarks (68, 2)."""
    low, high = neutral.min(0), neutral.max(0)
    side = float((high - low).max()) * 1.1
    corner = (low + high) / 2 - side / 2
    s, R, t = _similarity2d(points[STABLE], (neutral[STABLE] - corner) * (CROP / side))
    A = np.concatenate([s * R, t[:, None]], axis=1)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return cv2.warpAffine(grey, A, (CROP, CROP), flags=cv2.INTER_LINEAR).astype(np.float32) / 255


def _similarity2d(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    lift = np.zeros((len(source), 1))
    s, R, t = similarity_fit(np.hstack([source, lift]), np.hstack([target, lift]))
    return s, R[:2, :2], t[:2]


def displacements(points: np.ndarray, neutral: np.ndarray) -> np.ndarray:
    """Landmark motion (T, 68, 2) against neutral (68, 2), head motion removed, in face sizes."""
    size = float((neutral.max(0) - neutral.min(0)).max())
    moved = np.empty_like(points, dtype=np.float64)
    for number, frame in enumerate(points):
        s, R, t = _similarity2d(frame[STABLE], neutral[STABLE])
        moved[number] = s * frame @ R.T + t - neutral
    return moved / size


def activity(
    clips: Sequence[ClipObservation],
    rests: Sequence[ClipObservation],
    expression: Expression | None,
) -> np.ndarray:
    """Activity (T,) of one expression against the subject's rest, over the cameras that see it.

    Args:
        clips: one observation a camera, T frames of the cue window.
        rests: the same cameras at rest.
        expression: the script's entry, None when it is not in the script.
    """
    weights = landmark_weights(expression)
    total = np.zeros(len(clips[0].points))
    for clip, rest in zip(clips, rests, strict=True):
        neutral = np.median(rest.points, axis=0)
        look = np.median(rest.crops, axis=0)
        trust = float(np.median(clip.scores))
        moved = _motion(displacements(clip.points, neutral), weights)
        still = _motion(displacements(rest.points, neutral), weights)
        changed = np.abs(clip.crops - look).mean((1, 2))
        calm = np.abs(rest.crops - look).mean((1, 2))
        total += trust * (
            moved / (np.median(still) + _LANDMARK_FLOOR)
            + 0.5 * changed / (np.median(calm) + _LOOK_FLOOR)
        )
    return total / max(1e-9, sum(float(np.median(c.scores)) for c in clips))


def _motion(moved: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Root mean square motion (T,) of the points that take part."""
    return np.sqrt((moved**2).sum(-1) @ weights / weights.sum())


def suggest_peak(curve: np.ndarray, first_frame: int, at_rest: bool = False) -> Suggestion:
    """The apex of an activity curve (T,), or its calmest frame for the neutral expression.

    The apex is the middle of the plateau (within a tenth of the maximum), not its first frame.

    Raises:
        ValueError: the curve is empty or not finite.
    """
    if curve.size == 0 or not np.isfinite(curve).all():
        raise ValueError(f"activity has {curve.size} values, expected at least one, all finite")
    padded = np.pad(curve, 1, mode="edge")
    smooth = 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
    if at_rest:
        frame = int(np.argmin(smooth))
        spread = float(smooth.max() - smooth.min())
        return Suggestion(first_frame + frame, 1.0 / (1.0 + spread), curve)
    top = int(np.argmax(smooth))
    floor = float(smooth.min())
    level = floor + 0.9 * (float(smooth[top]) - floor)
    low = high = top
    while low > 0 and smooth[low - 1] >= level:
        low -= 1
    while high < len(smooth) - 1 and smooth[high + 1] >= level:
        high += 1
    plateau = np.arange(low, high + 1)
    rise = smooth[low : high + 1] - floor
    middle = float(plateau @ rise / rise.sum()) if rise.sum() > 0 else float(top)
    confidence = float(np.clip((smooth[top] - floor) / (1.0 + smooth[top]), 0.0, 1.0))
    return Suggestion(first_frame + round(middle), confidence, curve)


def candidates(suggestion: Suggestion, first_frame: int) -> list[int]:
    """Frames worth a look, best first: the suggestion, then the curve's other local maxima.

    At most CANDIDATES, at least CANDIDATE_GAP frames apart; absolute frames, the curve's first
    value being that of ``first_frame``.
    """
    curve = suggestion.activity
    padded = np.pad(curve, 1, constant_values=-np.inf)
    peaks = np.flatnonzero((curve >= padded[:-2]) & (curve >= padded[2:]))
    ranked = [first_frame + int(k) for k in peaks[np.argsort(-curve[peaks], kind="stable")]]
    chosen = [suggestion.frame]
    for frame in ranked:
        if len(chosen) < CANDIDATES and all(abs(frame - c) >= CANDIDATE_GAP for c in chosen):
            chosen.append(frame)
    return chosen
