"""Give each person's face its own motion, wrinkles and reddening.

The head model moves everybody's skin alike. Here each person has a matrix per vertex that adds to
this motion: linear in the coefficients, but outside the model's space. Folds darken and brighten
where a muscle gathers the skin, and effort reddens or pales it. All of this grows with
``twin.personal``, and the model that the stages fit has none of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from express50.geometry.sampling import smoothstep
from express50.head.model import HeadModel, landmarks_of
from express50.twin.surface import fractal, make_lattice, noise, spot

# Standard deviation of a matrix entry if the amount is 1: the person adds two fifths of a motion.
OWN_SHARE = 0.25
WAVE_M = 0.045  # wavelength of the matrices over the skin
DEPTH, FLUSH = 0.35, 0.2  # strength of folds and of redness at full effort
EFFORT = 2.5  # sum of coefficients that is full effort
# Folds by the muscles that make them, on the subject's left and right.
MUSCLES = {
    "forehead": ("browInnerUp", "browOuterUp"),
    "glabella": ("browDown",),
    "crow": ("eyeSquint", "cheekSquint", "cheekRaiser", "mouthSmile"),
    "cheek": ("mouthSmile", "noseSneer", "mouthUpperUp"),
}
SIDES = {"L": 1.0, "R": -1.0}  # the subject's left is +x


@dataclass(frozen=True, kw_only=True)
class LivingSkin:
    """Light and colour of one frame's skin, over places on the mean head."""

    folds: Mapping[str, float]  # activation, 0 to 1, by name and side such as ``crow_L``
    flush: float  # how much redder the flushed places are; negative is paler
    marks: np.ndarray  # (68, 3) landmarks of the mean head
    lattice: np.ndarray  # random values that make the person's folds irregular

    def factor(self, places: np.ndarray) -> np.ndarray:
        """Return the factor (N, 3) on the skin's colour at places (N, 3) of the mean head."""
        light = np.ones(len(places), np.float32)
        for name, depth in self.folds.items():
            if depth > 0.01:
                kind, side = name.split("_")
                light *= 1 - DEPTH * depth * self._fold(kind, SIDES[side], places)
        # Cheeks, nose, forehead and chin redden.
        marks = self.marks
        spots = [(0.5 * (marks[46] + marks[54]), 0.03, 1.0), (marks[30], 0.02, 0.7),
                 (0.5 * (marks[41] + marks[48]), 0.03, 1.0), (marks[8], 0.025, 0.4),
                 (marks[27] + [0, 0.04, 0], 0.04, 0.5)]  # fmt: skip
        total = np.zeros(len(places), np.float32)
        for centre, radius, weight in spots:
            total += weight * spot(places, centre, radius).astype(np.float32)
        red = self.flush * np.minimum(total, 1.0)
        tint = np.stack([0.15 * red, -red, -0.85 * red], 1)
        return (light[:, None] * (1 + FLUSH * tint)).astype(np.float32)

    def _fold(self, kind: str, side: float, places: np.ndarray) -> np.ndarray:
        """Return the darkness (N,) of folds, negative on the ridges beside them."""
        marks, wander = self.marks, noise(places / 0.012, self.lattice)
        x, y = side * places[:, 0], places[:, 1]
        ends = np.array([side, 1.0, 1.0])
        front = smoothstep(places[:, 2], marks[27, 2] - 0.07, marks[27, 2] - 0.04)
        brow, eye, mouth = (marks[i] * ends for i in ((24, 45, 54) if side > 0 else (19, 36, 48)))
        if kind == "forehead":
            up = y - brow[1]
            area = smoothstep(up, 0.006, 0.016) * smoothstep(up, 0.055, 0.035)
            return front * area * smoothstep(x, -0.012, 0.006) * _ripple(up / 0.009 + 0.35 * wander)
        if kind == "glabella":
            middle = 0.5 * (marks[21] + marks[22])
            area = spot(places[:, :2], middle[:2], 0.011) * smoothstep(x, -0.002, 0.001)
            return front * area * _ripple(x / 0.008 + 0.2 + 0.2 * wander)
        if kind == "crow":
            dx, dy = x - eye[0], y - eye[1]
            away = np.hypot(dx, dy)
            area = smoothstep(away, 0.006, 0.012) * smoothstep(away, 0.032, 0.018)
            angle = np.arctan2(dy, np.maximum(dx, 1e-6))
            return area * smoothstep(dx, 0.002, 0.008) * _ripple(angle / 0.45 + 0.3 * wander)
        wing = marks[35 if side > 0 else 31] * ends
        start, end = wing + [0.006, 0.004, 0], mouth + [0.012, -0.004, 0]
        along = end[:2] - start[:2]
        share = ((np.stack([x, y], 1) - start[:2]) @ along) / (along @ along)
        line = start[:2] + np.clip(share, 0, 1)[:, None] * along
        off = np.stack([x, y], 1) - line
        across = off @ np.array([along[1], -along[0]]) / np.linalg.norm(along)
        faded = spot(off, 0.0, 0.006) * smoothstep(share, -0.15, 0.1) * smoothstep(share, 1.3, 0.9)
        return 1.3 * front * faded * np.cos(np.clip(across / 0.004, -np.pi, np.pi))


def _ripple(phase: np.ndarray) -> np.ndarray:
    """Return 1 in valleys, one per period, and slightly under 0 on the ridges between."""
    return 1.2 * np.exp(-((((phase % 1.0) - 0.5) / 0.16) ** 2)) - 0.2


def own_motion(model: HeadModel, number: int, seed: int, amount: float) -> np.ndarray:
    """Draw the matrices (V, 3, 3) that map the model's motion to what a person adds to it."""
    template = model.template.double().numpy()
    rng = np.random.default_rng([seed, number, 15])
    field = np.empty((len(template), 3, 3))
    for row in range(3):
        for column in range(3):
            field[:, row, column] = fractal(template, make_lattice(rng), WAVE_M, 2)
    spread = float(np.sqrt((field**2).mean()))
    return (field * (OWN_SHARE * amount / max(spread, 1e-9))).astype(np.float32)


def own_offsets(model: HeadModel, own: np.ndarray, expression: np.ndarray) -> np.ndarray:
    """Return the rest offsets (V, 3) that own motion (V, 3, 3) adds to an expression (X,)."""
    moved = model.expression_dirs.double().numpy() @ expression
    return np.einsum("vij,vj->vi", own, moved)


def living_skin(
    model: HeadModel, number: int, seed: int, age: int, amount: float, expression: np.ndarray
) -> LivingSkin:
    """Return how a person's skin looks in an expression (X,)."""
    values = dict(zip(model.expression_names, expression, strict=True))
    rng = np.random.default_rng([seed, number, 16])
    lattice, lines = make_lattice(rng), amount * np.clip(0.5 + (age - 19) / 60, 0, 1.2)
    folds = {}
    for kind, muscles in MUSCLES.items():
        for side in SIDES:
            # No face folds equally on both sides.
            depth, gain = sum(values.get(f"{m}_{side}", 0.0) for m in muscles), rng.uniform(0.6, 1)
            folds[f"{kind}_{side}"] = float(gain * lines * np.clip(depth, 0, 1))
    # Two people of three redden with effort, the others turn pale.
    temper = rng.uniform(0.6, 1.0) * (1 if rng.uniform() < 2 / 3 else -0.7)
    flush = amount * temper * np.tanh(np.abs(expression).sum() / EFFORT)
    marks = landmarks_of(model).astype(np.float64)
    return LivingSkin(folds=folds, flush=float(flush), marks=marks, lattice=lattice)
