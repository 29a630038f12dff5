"""Made-up people: shape, a displacement the head model cannot express, and how they look."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from express50.geometry.smoothstep import smoothstep
from express50.head.model import HeadModel
from express50.twin.noise import fractal, make_lattice, random_stream

OFFSET_RMS_M = 1.2e-3
# Linear-light albedo of skin from light to deep (sRGB about 233 196 176 ... 92 62 49).
_SKIN_TONES = np.array(
    [
        [0.74, 0.50, 0.39],
        [0.64, 0.40, 0.28],
        [0.52, 0.30, 0.20],
        [0.38, 0.20, 0.12],
        [0.24, 0.12, 0.072],
        [0.13, 0.066, 0.042],
    ]
)
_HAIR_COLOURS = np.array(
    [
        [0.014, 0.011, 0.010],
        [0.035, 0.020, 0.012],
        [0.085, 0.045, 0.022],
        [0.24, 0.14, 0.065],
        [0.22, 0.065, 0.022],
        [0.30, 0.29, 0.28],
    ]
)
_EYE_COLOURS = np.array(
    [[0.09, 0.035, 0.012], [0.14, 0.07, 0.02], [0.13, 0.15, 0.06], [0.10, 0.19, 0.29]]
)
HAIR_STYLES = ("short", "side", "curly", "bob", "buzz", "swept")


@dataclass(frozen=True, kw_only=True)
class PersonLook:
    """Appearance of one subject; colours are linear light, the rest 0 to 1 unless it says so."""

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
    """One made-up person on a head model.

    Attributes:
        id: subject id.
        number: number in the id; seeds the subject's random traits.
        shape: (S,) shape coefficients.
        offsets: (V, 3) metres, added to the rest shape, orthogonal to the model's shape space.
        look: appearance.
    """

    id: str
    number: int
    shape: np.ndarray
    offsets: np.ndarray
    look: PersonLook


def make_subject(model: HeadModel, subject_id: str, number: int, seed: int) -> TwinSubject:
    """Draw one subject; it depends on the seed and the subject's number only."""
    rng = random_stream(seed, number, 1)
    shape = np.clip(0.8 * rng.standard_normal(len(model.shape_names)), -2.0, 2.0)
    offsets = _displacement(model, random_stream(seed, number, 2))
    look = _make_look(random_stream(seed, number, 3), number)
    return TwinSubject(id=subject_id, number=number, shape=shape, offsets=offsets, look=look)


def soft_mask(model: HeadModel) -> np.ndarray:
    """Weights (V,): 1 on skin, 0 on eyes, teeth, tongue and inside the mouth, soft at the lids."""
    template = model.template.double().numpy()
    inner = np.zeros(len(template), dtype=bool)
    for region in ("left_eyeball", "right_eyeball", "teeth", "tongue", "mouth_interior"):
        inner |= model.regions[region].numpy()
    weight = np.where(inner, 0.0, 1.0)
    for region in ("left_eyeball", "right_eyeball"):
        ball = template[model.regions[region].numpy()]
        centre = 0.5 * (ball.min(0) + ball.max(0))
        radius = 0.5 * (ball.max(0) - ball.min(0)).max()
        distance = np.linalg.norm(template - centre, axis=1)
        weight *= smoothstep(distance, 1.15 * radius, 1.15 * radius + 0.012)
    return weight


def _displacement(model: HeadModel, rng: np.random.Generator) -> np.ndarray:
    """Draw a smooth field (V, 3) float32, metres, that no shape coefficients can produce."""
    template = model.template.double().numpy()
    weight = soft_mask(model)
    field = np.empty_like(template)
    for axis in range(3):
        broad = fractal(template, make_lattice(rng), 0.05, 1)
        fine = fractal(template, make_lattice(rng), 0.02, 1)
        field[:, axis] = weight * (broad + 0.35 * fine)
    # What lies in the span of the shape directions is taken out, so that no tracker can find it.
    basis = model.shape_dirs.double().numpy().reshape(-1, len(model.shape_names))
    gram = basis.T @ basis
    gram += 1e-9 * np.trace(gram) * np.eye(len(gram))
    field = field - (basis @ np.linalg.solve(gram, basis.T @ field.ravel())).reshape(field.shape)
    rms = np.sqrt((np.linalg.norm(field, axis=1)[weight > 0.5] ** 2).mean())
    return (field * (OFFSET_RMS_M / rms)).astype(np.float32)


def _make_look(rng: np.random.Generator, number: int) -> PersonLook:
    """Draw an appearance; neighbouring numbers get unlike skin and hair."""
    # A step of 0.38 through [0, 1) visits it evenly, so that even four subjects are varied.
    tone = (0.15 + 0.381966 * number + rng.uniform(-0.08, 0.08)) % 1.0
    skin = _blend(_SKIN_TONES, tone) * rng.uniform(0.93, 1.07, 3)
    gender = "female" if (number + int(rng.integers(0, 2))) % 2 else "male"
    age = int(rng.integers(19, 66))
    dark = smoothstep(np.array(tone), 0.35, 0.7)
    hair_place = rng.uniform(0.0, 0.75) * (1.0 - float(dark))
    hair = _blend(_HAIR_COLOURS[:5], hair_place)
    if age > 56:
        hair = 0.4 * hair + 0.6 * _HAIR_COLOURS[5]
    style = HAIR_STYLES[(number + int(rng.integers(0, 2)) * 3) % len(HAIR_STYLES)]
    length = {"short": 0.035, "side": 0.06, "curly": 0.05, "bob": 0.2, "buzz": 0.008, "swept": 0.09}
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
        hair_length_m=length[style] * float(rng.uniform(0.8, 1.25)),
        cloth=rng.uniform(0.03, 0.3) * rng.uniform(0.7, 1.3, 3),
        age=age,
        gender=gender,
    )


def _blend(table: np.ndarray, place: float) -> np.ndarray:
    """Interpolate the rows of a table (N, 3) at ``place`` in [0, 1]."""
    x = float(np.clip(place, 0.0, 1.0)) * (len(table) - 1)
    low = min(int(x), len(table) - 2)
    return table[low] + (table[low + 1] - table[low]) * (x - low)
