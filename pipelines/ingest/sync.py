"""Sync: whether all cameras show the same moment in the same frame, told by how much moves.

Every camera sees the same face move, each in its own way, but at the same times. The curve of how
much changes from frame to frame is compared with the other cameras' middle curve: the most likely
path of steps (Viterbi) through the lags of a few frames says where a camera lost or doubled frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

SIDE = 96  # longer side of the pictures that movement is measured in
FEWEST_CAMERAS, FEWEST_FRAMES = 3, 24
SPAN = 15  # frames whose mean is taken off: views differ in how much they see, not in when
STEP_COST = 10.0  # what a change of lag costs, in units of log likelihood
FRAME_COST = 1.0  # and every frame of it: few frames are lost more often than many
START_COST = 7.0  # what being out of step from the start costs
ALIKE = 0.35  # correlation with the others from which a camera's movement tells anything
EARLY = 8  # frames before which a change of lag cannot be told from one before the start
LEAST_SPREAD = 0.15  # of curves of unit variance; views are never more alike than that
STILL = 0.05  # share of a camera's usual movement below which a frame repeats the one before


@dataclass(frozen=True)
class Step:
    """From ``frame`` on, a camera's frame n shows what the others show in n + ``lag``."""

    frame: int
    lag: int


def small_grey(image: np.ndarray) -> np.ndarray:
    """Grey image float32, longer side at most 96 pixels, of an image (H, W, 3) uint8."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    scale = SIDE / max(grey.shape)
    if scale >= 1:
        return grey
    size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)


def movement(before: np.ndarray | None, after: np.ndarray) -> float:
    """Mean change between two small grey images, grey levels; 0 for the first."""
    return 0.0 if before is None else float(np.abs(after - before).mean())


def look_at_sync(
    moves: Mapping[str, np.ndarray], clips: Sequence[int], reach: int
) -> tuple[dict[str, list[Step]], dict[str, str]]:
    """Steps of the cameras that are not in step, and why some cannot be judged.

    Args:
        moves: movement (F,) by camera, all of one length.
        clips: frames of each clip; clips are recordings of their own.
        reach: largest lag, frames.
    """
    names = sorted(moves)
    if len(names) < FEWEST_CAMERAS:
        return {}, dict.fromkeys(names, f"fewer than {FEWEST_CAMERAS} cameras")
    curves = {name: np.asarray(moves[name], dtype=np.float64) for name in names}
    steps: dict[str, list[Step]] = {}
    untold: dict[str, str] = {}
    judged: set[str] = set()
    start = 0
    for count in clips:
        if count >= FEWEST_FRAMES:
            found, alike = _of_clip({n: c[start : start + count] for n, c in curves.items()}, reach)
            judged |= alike
            for name, path in found.items():
                steps.setdefault(name, []).extend(Step(start + s.frame, s.lag) for s in path)
        start += count
    for name in set(names) - judged:
        untold[name] = "too few frames or too little movement that others see too"
    return steps, dict(sorted(untold.items()))


def _of_clip(moves: Mapping[str, np.ndarray], reach: int) -> tuple[dict[str, list[Step]], set[str]]:
    """Steps by camera of one clip, and the cameras whose movement is like the others'.

    The camera for which most speaks is taken out first: left in, it would bend what the others are
    compared with.
    """
    curves = {name: _curve(moves[name]) for name in moves}
    steps: dict[str, list[Step]] = {}
    alike: set[str] = set()
    found: set[str] = set()
    while len(curves) - len(found) >= FEWEST_CAMERAS:
        left = {name: curve for name, curve in curves.items() if name not in found}
        rest = {n: np.median([c for m, c in left.items() if m != n], axis=0) for n in left}
        # How well the usual camera fits: one out of step would excuse itself.
        misses = [np.mean((left[n] - rest[n])[1:] ** 2) for n in left]
        spread = max(float(np.median(misses)), LEAST_SPREAD)
        gains = {}
        for name in left:
            path, gain = _likeliest(left[name], rest[name], reach, spread)
            if _likeness(left[name], rest[name], path) >= ALIKE:
                alike.add(name)
                if path.any():
                    gains[name] = gain, path
        if not gains:
            break
        worst = max(gains, key=lambda name: gains[name][0])
        found.add(worst)
        path = gains[worst][1]
        edges = np.flatnonzero(np.diff(path, prepend=0))
        steps[worst] = [Step(int(t), int(path[t])) for t in edges]
    return steps, alike


def _curve(moves: np.ndarray) -> np.ndarray:
    """Logarithm of movement without its slow part, in units of its own spread; (F,)."""
    floor = max(float(np.median(moves)) * 0.2, 1e-3)
    values = np.log(moves + floor)
    values[0] = values[1]  # nothing comes before the first frame
    span = min(SPAN, len(values) // 2 * 2 - 1)
    padded = np.pad(values, span // 2, mode="reflect")
    values = values - np.convolve(padded, np.ones(span) / span, mode="valid")
    return values / max(float(values.std()), 1e-6)


def _likeliest(
    curve: np.ndarray, rest: np.ndarray, reach: int, spread: float
) -> tuple[np.ndarray, float]:
    """Lag of each frame (F,), the path of least misses and changes, and what it gains over none."""
    count = len(curve)
    lags = np.arange(-reach, reach + 1)
    at = np.arange(count)[:, None] + lags
    beyond = (at < 0) | (at >= count)
    miss = (curve[:, None] - rest[np.clip(at, 0, count - 1)]) ** 2 / (2 * spread)
    # Beyond the clip nothing can be compared, so that no lag is better there than being in step.
    miss = np.minimum(np.where(beyond, miss[:, reach : reach + 1], miss), 6.0)
    total = miss[0] + (START_COST + FRAME_COST * np.abs(lags)) * (lags != 0)
    far = np.abs(lags[:, None] - lags)
    change = (STEP_COST + FRAME_COST * far) * (far > 0)
    never = np.where(far > 0, np.inf, 0.0)
    came = np.zeros((count, len(lags)), dtype=np.int64)
    for t in range(1, count):
        # So near the end a change would be told mostly by frames that nothing is compared with.
        late = t >= count - 2 * reach
        ways = total[:, None] + (never if late else change)
        came[t] = ways.argmin(axis=0)
        total = ways.min(axis=0) + miss[t]
    path = np.zeros(count, dtype=np.int64)
    state = int(total.argmin())
    gain = float(miss[:, reach].sum() - total[state])
    for t in range(count - 1, -1, -1):
        path[t] = lags[state]
        state = int(came[t, state])
    return path, gain


def _likeness(curve: np.ndarray, rest: np.ndarray, path: np.ndarray) -> float:
    """Correlation of a curve with the others' along a path of lags."""
    at = np.arange(len(curve)) + path
    inside = (at >= 1) & (at < len(curve))
    if inside.sum() < FEWEST_FRAMES // 2:
        return 0.0
    a, b = curve[inside], rest[at[inside]]
    if a.std() < 1e-9 or b.std() < 1e-9:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])


def step_words(steps: Sequence[Step]) -> str:
    """Steps of a camera, in words."""
    words = []
    before = 0
    for step in steps:
        change = step.lag - before
        what = "loses" if change > 0 else "repeats or gains"
        early = step.frame < EARLY and before == 0
        where = "from its start" if early else f"at about frame {step.frame}"
        frames = f"{abs(change)} frame{'s' if abs(change) > 1 else ''}"
        if early:
            side = "ahead of" if step.lag > 0 else "behind"
            words.append(f"is {frames} {side} the others {where}")
        else:
            words.append(f"{what} {frames} {where}")
        before = step.lag
    return "; ".join(words) + "; cut its footage so that the cameras show the same moment"


def stuck_frames(moves: Mapping[str, np.ndarray]) -> dict[str, list[int]]:
    """Frames of a camera that repeat the one before while most others move, by camera."""
    names = sorted(moves)
    if len(names) < FEWEST_CAMERAS:
        return {}
    table = np.stack([moves[name] for name in names])
    usual = np.median(table, axis=1, keepdims=True)
    still = table < STILL * usual
    moving = (table > 0.5 * usual).sum(axis=0) > len(names) // 2
    found = {}
    for name, row in zip(names, still & moving, strict=True):
        frames = np.flatnonzero(row[1:]) + 1
        if frames.size:
            found[name] = frames.tolist()
    return found
