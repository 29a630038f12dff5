"""A subject's performance of the script: timing, intensity, blinks and sway per frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from express50.capture.expressions import Expression
from express50.errors import HeadModelError
from express50.geometry.smoothstep import smoothstep
from express50.geometry.transforms import axis_angle_to_matrix, matrix_to_axis_angle
from express50.head.model import HeadModel
from express50.twin.noise import random_stream
from express50.twin.rig import TARGET


@dataclass(frozen=True, kw_only=True)
class TwinPerformance:
    """Parameters of every frame, in head-model terms.

    Attributes:
        cues: (expression id, first frame, last frame) of each window, inclusive.
        peaks: expression id -> frame at which the expression is strongest.
        strength: (F,) how far the frame's expression is played, 0 to 1.
        expression: (F, X) coefficients; jaw, neck (F, 3), eyes (F, 6) axis-angle, radians.
        R: (F, 3, 3) and t (F, 3): world = R @ head + t, metres.
    """

    cues: tuple[tuple[str, int, int], ...]
    peaks: dict[str, int]
    strength: np.ndarray
    expression: np.ndarray
    jaw: np.ndarray
    neck: np.ndarray
    eyes: np.ndarray
    R: np.ndarray
    t: np.ndarray

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.strength)


def perform(
    model: HeadModel,
    script: Sequence[Expression],
    frames_per_expression: int,
    fps: float,
    number: int,
    seed: int,
) -> TwinPerformance:
    """Play a script once.

    Each window goes rest, onset, apex, offset, rest with the apex anywhere in its middle; how
    strongly, how fast and how symmetrically is the subject's own.

    Raises:
        HeadModelError: the head model does not name the script's expression directions.
    """
    names = {name: column for column, name in enumerate(model.expression_names)}
    _check_names(model, script)
    count = frames_per_expression * len(script)
    expression = np.zeros((count, len(names)))
    jaw, neck = np.zeros((count, 3)), np.zeros((count, 3))
    gaze, strength = np.zeros((count, 2)), np.zeros(count)
    cues, peaks = [], {}
    for order, entry in enumerate(script):
        # Seeded by the id, so that leaving expressions out does not change the others.
        rng = random_stream(seed, number, 4, *entry.id.encode())
        first = order * frames_per_expression
        peak, curve = _envelope(rng, frames_per_expression, fps)
        span = slice(first, first + frames_per_expression)
        expression[span] += curve[:, None] * _played(rng, entry, names)
        jaw[span] += curve[:, None] * np.array(entry.jaw) * rng.uniform(0.85, 1.1)
        neck[span] += curve[:, None] * (np.array(entry.neck) + rng.normal(0.0, 0.015, 3))
        gaze[span] += curve[:, None] * np.array(entry.gaze) * rng.uniform(0.85, 1.05)
        gaze[span] += rng.normal(0.0, 0.02, 2)
        strength[span] = curve
        _blink(rng, expression[span], peak, names)
        cues.append((entry.id, first, first + frames_per_expression - 1))
        peaks[entry.id] = first + peak
    rest = _fidget(random_stream(seed, number, 5), count, fps, names)
    expression += (1.0 - strength)[:, None] * rest
    R, t = _sway(random_stream(seed, number, 6), model, count, fps)
    eyes = np.tile(matrix_to_axis_angle(gaze_rotation(gaze)), (1, 2))
    return TwinPerformance(
        cues=tuple(cues), peaks=peaks, strength=strength, expression=expression,
        jaw=jaw, neck=neck, eyes=eyes, R=R, t=t,
    )  # fmt: skip


def gaze_rotation(gaze: np.ndarray) -> np.ndarray:
    """Return eye rotations (F, 3, 3) of yaw to the subject's left (+x) and pitch upwards (F, 2)."""
    zero = np.zeros(len(gaze))
    yaw = axis_angle_to_matrix(np.stack([zero, gaze[:, 0], zero], axis=1))
    pitch = axis_angle_to_matrix(np.stack([-gaze[:, 1], zero, zero], axis=1))
    return yaw @ pitch


def _check_names(model: HeadModel, script: Sequence[Expression]) -> None:
    wanted = {name for entry in script for name in entry.controls}
    known = wanted & set(model.expression_names)
    if len(known) < 0.6 * len(wanted):
        raise HeadModelError(
            f"head model {model.name!r}: names {len(known)} of the script's {len(wanted)} controls;"
            " the twin needs a head with named expressions, such as 'procedural' or ICT-FaceKit"
        )


def _envelope(rng: np.random.Generator, count: int, fps: float) -> tuple[int, np.ndarray]:
    """Draw a peak's index and strength (count,), 1 at the peak and less everywhere else."""
    low, high = max(1, round(0.3 * count)), max(2, round(0.72 * count))
    peak = int(rng.integers(low, min(high, count - 2) + 1))
    # Both ends of the window are near rest; a movement rarely takes over half a second.
    onset = min(rng.uniform(0.2, 0.36) * count, peak + 0.9, 0.7 * fps)
    offset = min(rng.uniform(0.24, 0.42) * count, count - peak - 0.1, 0.7 * fps)
    hold = rng.uniform(0.1, 0.9) * min(0.06 * count, 0.5 * fps)
    d = np.arange(count) - peak
    away = np.maximum(np.abs(d) - hold, 0.0) / np.where(d < 0, max(onset, 1.3), max(offset, 1.3))
    sag = 1.0 - 0.06 * np.minimum(np.abs(d) / max(1.0, 0.15 * count), 1.0)
    return peak, sag * (1.0 - smoothstep(away, 0.0, 1.0))


def _played(rng: np.random.Generator, entry: Expression, names: dict[str, int]) -> np.ndarray:
    """Return the coefficients (X,) of this subject's version of an expression at its peak."""
    out = np.zeros(len(names))
    strength = rng.uniform(0.78, 1.05)
    for name, value in entry.controls.items():
        gain = rng.normal(1.0, 0.1)
        if name in names:
            out[names[name]] = np.clip(strength * gain * value, -1.0, 1.1)
    if entry.controls:
        # People rarely move one muscle alone: a few others join in a little.
        for column in rng.choice(len(names), size=min(3, len(names)), replace=False):
            if list(names)[column].startswith(("mouth", "brow", "cheek", "nose")):
                out[column] += rng.uniform(0.0, 0.08)
    return out


def _blink(
    rng: np.random.Generator, expression: np.ndarray, peak: int, names: dict[str, int]
) -> None:
    """Blink in some windows, at least two frames away from the peak; edits ``expression``."""
    count = len(expression)
    allowed = [f for f in range(count) if abs(f - peak) >= 2 + count // 24]
    if rng.uniform() > 0.35 or not allowed:
        return
    centre, length = allowed[int(rng.integers(len(allowed)))], 1.0 + count / 40.0
    closing = np.clip(1.2 - np.abs(np.arange(count) - centre) / length, 0.0, 1.0)
    closing[abs(np.arange(count) - peak) < 2] = 0.0
    for side in ("eyeBlink_L", "eyeBlink_R"):
        if side in names:
            column = names[side]
            expression[:, column] = np.maximum(expression[:, column], closing)


def _fidget(rng: np.random.Generator, count: int, fps: float, names: dict[str, int]) -> np.ndarray:
    """Draw the small movements (F, X) of a face that is not performing."""
    out = np.zeros((count, len(names)))
    for name in ("mouthPress_L", "mouthPress_R", "browInnerUp_L", "browDown_R", "mouthSmile_L"):
        if name in names:
            out[:, names[name]] = 0.08 * np.maximum(_wander(rng, count, fps), 0.0)
    return out


def _wander(rng: np.random.Generator, count: int, fps: float) -> np.ndarray:
    """Smooth motion (F,) of about unit size: a few slow sines."""
    time = np.arange(count) / fps
    waves = [
        np.sin(2 * np.pi * (time / period + rng.uniform()))
        for period in rng.uniform([1.3, 2.5, 5.0], [2.5, 5.0, 9.0])
    ]
    return np.sum(waves, axis=0) / 1.5


def _sway(
    rng: np.random.Generator, model: HeadModel, count: int, fps: float
) -> tuple[np.ndarray, np.ndarray]:
    """Place the head in the world: turned about the neck joint, near the rig's target."""
    template = model.template.double().numpy()
    head = (model.regions["face"] | model.regions["scalp"]).numpy()
    centre = 0.5 * (template[head].min(0) + template[head].max(0))
    pivot = (model.joint_regressor.double().numpy() @ template)[1]
    lean = rng.normal(0.0, 1.0, 3) * np.radians([2.5, 4.0, 1.5])
    turn = np.stack([_wander(rng, count, fps) for _ in range(3)], axis=1) * np.radians(
        [1.2, 1.6, 0.8]
    )
    drift = np.stack([_wander(rng, count, fps) for _ in range(3)], axis=1) * 0.003
    R = axis_angle_to_matrix(lean + turn)
    place = TARGET - centre + rng.uniform(-0.008, 0.008, 3) + drift
    return R, pivot + place - R @ pivot
