"""Make up people: their shape, their look, and how they perform the script.

A subject has coefficients of the head model, displacements that the model cannot express, and a
look. Its performance has its own timing, strength, blinks and sway.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from express50.capture.expressions import Expression
from express50.errors import HeadModelError
from express50.geometry.sampling import smoothstep
from express50.geometry.transforms import axis_angle_to_matrix, matrix_to_axis_angle
from express50.head.model import HeadModel, in_regions
from express50.twin.rig import TARGET
from express50.twin.surface import fractal, make_lattice

OFFSET_RMS_M = 1.2e-3
# Standard deviation of an entry of `own_motion` if `twin.personal` is 1: the person adds two fifths
# of a motion; wavelength of the entries over the skin, metres.
OWN_SHARE, WAVE_M = 0.25, 0.045
# Linear-light albedo of skin from light to deep (sRGB about 233 196 176 ... 92 62 49).
_SKIN_TONES = np.array([
    [0.74, 0.50, 0.39], [0.64, 0.40, 0.28], [0.52, 0.30, 0.20], [0.38, 0.20, 0.12],
    [0.24, 0.12, 0.072], [0.13, 0.066, 0.042],
])  # fmt: skip
_HAIR_COLOURS = np.array([
    [0.014, 0.011, 0.010], [0.035, 0.020, 0.012], [0.085, 0.045, 0.022], [0.24, 0.14, 0.065],
    [0.22, 0.065, 0.022], [0.30, 0.29, 0.28],
])  # fmt: skip
_EYE_COLOURS = np.array([
    [0.09, 0.035, 0.012], [0.14, 0.07, 0.02], [0.13, 0.15, 0.06], [0.10, 0.19, 0.29],
])  # fmt: skip
# Style and length in metres.
_HAIR_LENGTHS = {
    "short": 0.035, "side": 0.06, "curly": 0.05, "bob": 0.2, "buzz": 0.008, "swept": 0.09,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class PersonLook:
    """Appearance of one subject; colours are linear light, other numbers are factors."""

    skin: np.ndarray
    flush: float
    freckles: float
    moles: int
    stubble: float
    brow_density: float
    lips: np.ndarray
    gloss: float
    eyes: np.ndarray
    hair: np.ndarray
    hair_style: str
    hair_length_m: float
    cloth: np.ndarray
    age: int
    gender: str


@dataclass(frozen=True, kw_only=True)
class TwinSubject:
    """One made-up person on a head model."""

    id: str
    number: int  # of the id; seeds the subject's random traits
    shape: np.ndarray  # (S,) coefficients
    offsets: np.ndarray  # (V, 3) metres, added at rest, orthogonal to the model's shape space
    look: PersonLook
    own: np.ndarray | None = None  # (V, 3, 3) from `own_motion`


def make_subject(
    model: HeadModel, subject_id: str, number: int, seed: int, personal: float = 0.0
) -> TwinSubject:
    """Draw one subject, which depends only on the seed, its number and `twin.personal`."""
    rng = np.random.default_rng([seed, number, 1])
    shape = np.clip(rng.standard_normal(len(model.shape_names)), -2.5, 2.5)
    rng = np.random.default_rng([seed, number, 2])
    template = model.template.double().numpy()
    weight = soft_mask(model)
    field = np.empty_like(template)
    for axis in range(3):
        broad = fractal(template, make_lattice(rng), 0.05, 1)
        fine = fractal(template, make_lattice(rng), 0.02, 1)
        field[:, axis] = weight * (broad + 0.35 * fine)
    # The part within the span of the shape directions is removed: no tracker can express the rest.
    basis = model.shape_dirs.double().numpy().reshape(-1, len(model.shape_names))
    gram = basis.T @ basis
    gram += 1e-9 * np.trace(gram) * np.eye(len(gram))
    field = field - (basis @ np.linalg.solve(gram, basis.T @ field.ravel())).reshape(field.shape)
    rms = np.sqrt((np.linalg.norm(field, axis=1)[weight > 0.5] ** 2).mean())
    offsets = (field * (OFFSET_RMS_M / rms)).astype(np.float32)
    look = _make_look(np.random.default_rng([seed, number, 3]), number)
    own = None
    if personal:
        # The inside of the mouth moves too, or it would come through the lips.
        moved = np.where(model.regions["mouth_interior"].numpy(), 1.0, weight)
        own = own_motion(model, number, seed, personal) * moved[:, None, None].astype(np.float32)
    return TwinSubject(
        id=subject_id, number=number, shape=shape, offsets=offsets, look=look, own=own
    )


def own_motion(model: HeadModel, number: int, seed: int, amount: float) -> np.ndarray:
    """Draw the matrices (V, 3, 3) that map the model's motion to what a person adds to it.

    They are linear in the coefficients, but outside the model's space.
    """
    template = model.template.double().numpy()
    rng = np.random.default_rng([seed, number, 15])
    field = np.empty((len(template), 3, 3))
    for row in range(3):
        for column in range(3):
            field[:, row, column] = fractal(template, make_lattice(rng), WAVE_M, 2)
    spread = float(np.sqrt((field**2).mean()))
    return (field * (OWN_SHARE * amount / max(spread, 1e-9))).astype(np.float32)


def soft_mask(model: HeadModel) -> np.ndarray:
    """Return weights (V,): 1 on skin, 0 on eyes and inside the mouth, soft at the lids."""
    template = model.template.double().numpy()
    inner = ("left_eyeball", "right_eyeball", "teeth", "tongue", "mouth_interior")
    weight = np.where(in_regions(model, inner), 0.0, 1.0)
    for region in ("left_eyeball", "right_eyeball"):
        ball = template[model.regions[region].numpy()]
        centre = 0.5 * (ball.min(0) + ball.max(0))
        radius = 0.5 * (ball.max(0) - ball.min(0)).max()
        distance = np.linalg.norm(template - centre, axis=1)
        weight *= smoothstep(distance, 1.15 * radius, 1.15 * radius + 0.012)
    return weight


def _make_look(rng: np.random.Generator, number: int) -> PersonLook:
    """Draw an appearance; skin and hair of consecutive numbers differ."""
    # Steps of 0.38 through [0, 1) cover it evenly, so that even four subjects vary.
    tone = (0.15 + 0.381966 * number + rng.uniform(-0.08, 0.08)) % 1.0
    skin = _blend(_SKIN_TONES, tone) * rng.uniform(0.93, 1.07, 3)
    gender = "female" if (number + int(rng.integers(0, 2))) % 2 else "male"
    age = int(rng.integers(19, 66))
    dark = smoothstep(np.array(tone), 0.35, 0.7)
    hair_place = rng.uniform(0.0, 0.75) * (1.0 - float(dark))
    hair = _blend(_HAIR_COLOURS[:5], hair_place)
    if age > 56:
        hair = 0.4 * hair + 0.6 * _HAIR_COLOURS[5]
    style = list(_HAIR_LENGTHS)[(number + int(rng.integers(0, 2)) * 3) % len(_HAIR_LENGTHS)]
    eyes = _blend(_EYE_COLOURS, rng.uniform(0.0, 1.0) * (1.0 - 0.8 * float(dark)))
    return PersonLook(
        skin=skin,
        flush=float(rng.uniform(0.3, 1.0)),
        freckles=float(rng.uniform(0.0, 1.0) ** 3 * (1.0 - float(dark))),
        moles=int(rng.integers(2, 9)),
        stubble=float(rng.uniform(0.2, 0.9)) if gender == "male" else 0.0,
        brow_density=float(rng.uniform(0.5, 0.88)),
        lips=skin * rng.uniform([0.80, 0.50, 0.52], [0.95, 0.62, 0.70]),
        gloss=float(rng.uniform(0.6, 1.2)),
        eyes=eyes,
        hair=hair * rng.uniform(0.85, 1.15),
        hair_style=style,
        hair_length_m=_HAIR_LENGTHS[style] * float(rng.uniform(0.8, 1.25)),
        cloth=rng.uniform(0.03, 0.3) * rng.uniform(0.7, 1.3, 3),
        age=age,
        gender=gender,
    )


def _blend(table: np.ndarray, place: float) -> np.ndarray:
    """Interpolate the rows of a table (N, 3) at ``place`` in [0, 1]."""
    rows = np.arange(len(table))
    return np.array([np.interp(place * rows[-1], rows, column) for column in table.T])


@dataclass(frozen=True, kw_only=True)
class TwinPerformance:
    """Parameters of every frame, in head-model terms; world = R @ head + t, metres."""

    cues: tuple[tuple[str, int, int], ...]  # expression id, first and last frame of each window
    peaks: dict[str, int]  # expression id -> frame at which the expression is strongest
    strength: np.ndarray  # (F,) strength of the frame's expression, 0 to 1
    expression: np.ndarray  # (F, X) coefficients
    jaw: np.ndarray  # (F, 3) axis-angle, radians; so are neck (F, 3) and eyes (F, 6)
    neck: np.ndarray
    eyes: np.ndarray
    R: np.ndarray  # (F, 3, 3)
    t: np.ndarray  # (F, 3)

    @property
    def frames(self) -> int:
        """Return the number of frames."""
        return len(self.strength)


# Controls that move a little between expressions.
_FIDGETS = ("mouthPress_L", "mouthPress_R", "browInnerUp_L", "browDown_R", "mouthSmile_L")


def perform(
    model: HeadModel,
    script: Sequence[Expression],
    frames_per_expression: int,
    fps: float,
    number: int,
    seed: int,
) -> TwinPerformance:
    """Perform a script once; each cue window has rest, onset, a peak near its middle, offset, rest.

    Raises:
        HeadModelError: the head model does not name the script's expression directions.
    """
    names = {name: column for column, name in enumerate(model.expression_names)}
    wanted = {name for entry in script for name in entry.controls}
    if len(wanted & set(names)) < 0.6 * len(wanted):
        raise HeadModelError(
            f"head model {model.name!r}: names {len(wanted & set(names))} of the script's"
            f" {len(wanted)} controls; the twin needs a head with named expressions, such as"
            " 'procedural' or ICT-FaceKit"
        )
    count = frames_per_expression * len(script)
    expression = np.zeros((count, len(names)))
    jaw, neck = np.zeros((count, 3)), np.zeros((count, 3))
    gaze, strength = np.zeros((count, 2)), np.zeros(count)
    cues, peaks = [], {}
    for order, entry in enumerate(script):
        # Seeded by the expression's id, so that leaving some out does not change the others.
        rng = np.random.default_rng([seed, number, 4, *entry.id.encode()])
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
    rng = np.random.default_rng([seed, number, 5])
    for name in (name for name in _FIDGETS if name in names):
        small = 0.08 * np.maximum(_wander(rng, count, fps), 0.0)
        expression[:, names[name]] += (1.0 - strength) * small
    R, t = _sway(np.random.default_rng([seed, number, 6]), model, count, fps)
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


def _envelope(rng: np.random.Generator, count: int, fps: float) -> tuple[int, np.ndarray]:
    """Draw a peak's index and the strengths (count,), 1 at the peak and less elsewhere."""
    low, high = max(1, round(0.3 * count)), max(2, round(0.72 * count))
    peak = int(rng.integers(low, min(high, count - 2) + 1))
    # Both ends of the window are near rest; onset and offset take at most 0.7 seconds.
    onset = min(rng.uniform(0.2, 0.36) * count, peak + 0.9, 0.7 * fps)
    offset = min(rng.uniform(0.24, 0.42) * count, count - peak - 0.1, 0.7 * fps)
    hold = rng.uniform(0.1, 0.9) * min(0.06 * count, 0.5 * fps)
    d = np.arange(count) - peak
    away = np.maximum(np.abs(d) - hold, 0.0) / np.where(d < 0, max(onset, 1.3), max(offset, 1.3))
    sag = 1.0 - 0.06 * np.minimum(np.abs(d) / max(1.0, 0.15 * count), 1.0)
    return peak, sag * (1.0 - smoothstep(away, 0.0, 1.0))


def _played(rng: np.random.Generator, entry: Expression, names: dict[str, int]) -> np.ndarray:
    """Draw the coefficients (X,) of this subject's version of an expression at its peak."""
    out = np.zeros(len(names))
    strength = rng.uniform(0.78, 1.05)
    for name, value in entry.controls.items():
        gain = rng.normal(1.0, 0.1)
        if name in names:
            out[names[name]] = np.clip(strength * gain * value, -1.0, 1.1)
    if entry.controls:
        # People rarely move one muscle alone: a few others move a little too.
        for column in rng.choice(len(names), size=min(3, len(names)), replace=False):
            if list(names)[column].startswith(("mouth", "brow", "cheek", "nose")):
                out[column] += rng.uniform(0.0, 0.08)
    return out


def _blink(
    rng: np.random.Generator, expression: np.ndarray, peak: int, names: dict[str, int]
) -> None:
    """Add a blink in some windows, at least two frames off the peak; edits ``expression``."""
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


def _wander(rng: np.random.Generator, count: int, fps: float) -> np.ndarray:
    """Draw a smooth motion (F,) of about unit size, a sum of slow sines."""
    time = np.arange(count) / fps
    waves = [
        np.sin(2 * np.pi * (time / period + rng.uniform()))
        for period in rng.uniform([1.3, 2.5, 5.0], [2.5, 5.0, 9.0])
    ]
    return np.sum(waves, axis=0) / 1.5


def _sway(
    rng: np.random.Generator, model: HeadModel, count: int, fps: float
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the head's poses R (F, 3, 3) and t (F, 3): turned at the neck, near the rig's target."""
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
