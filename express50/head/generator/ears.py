"""The ear: from its attachment on the skin over the back to the helix, then the concha's relief."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from express50.head.generator.field import cast, labels
from express50.head.generator.mesh import HalfMesh

Array = np.ndarray

EAR_CENTER = np.array([7.0, -15.0])  # (y, z) of the ear's own origin, mm
EAR_TILT = np.radians(12.0)  # the ear's long axis leans back
_POINTS = 40
# Outline (backwards, up) in mm from the helix's root over the top to lobe and tragus.
_OUTLINE = np.array([
    (-7.5, 8), (-6.5, 20), (0, 29), (9, 32), (18, 28.5), (23.5, 18), (23, 5), (18, -8),
    (11.5, -18), (5.5, -26.5), (-1, -30.5), (-6.5, -27), (-8.5, -18), (-9.5, -9), (-9.5, 0),
])  # fmt: skip
_CONCHA = np.array([-1.5, -4.0])


def _outline() -> Array:
    closed = np.concatenate([_OUTLINE, _OUTLINE[:1]])
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    curve = CubicSpline(length, closed, bc_type="periodic")
    return curve(np.linspace(0, length[-1], _POINTS, endpoint=False))


def _place(pq: Array, x: Array) -> Array:
    """Return ear-plane coordinates (backwards, up) to head space (N,3)."""
    c, s = np.cos(EAR_TILT), np.sin(EAR_TILT)
    back = c * pq[:, 0] + s * pq[:, 1]
    up = -s * pq[:, 0] + c * pq[:, 1]
    return np.stack([x, EAR_CENTER[0] + up, EAR_CENTER[1] - back], 1)


def _flare(pq: Array) -> Array:
    """Return the distance (mm) of the ear's plane from the head's side."""
    back = np.logaddexp(0.0, 0.35 * (pq[:, 0] + 5.0)) / 0.35  # a smooth max(0, p + 5)
    return 0.5 + 0.5 * back - 0.0016 * pq[:, 1] ** 2


def _bump(value: Array, center: float, width: float) -> Array:
    return np.exp(-(((value - center) / width) ** 2))


def _relief(pq: Array, inset: Array, rim: Array) -> Array:
    """Height (mm) of the front sheet: helix fold, scapha, antihelix, concha, tragus, lobe."""
    back_top = 1 / (1 + np.exp(-(rim[:, 0] * 0.35 + rim[:, 1] * 0.12 - 0.2)))
    helix = back_top * (2.6 * _bump(inset, 0.06, 0.07) - 2.0 * _bump(inset, 0.24, 0.09))
    ridge = 2.6 * back_top * _bump(inset, 0.44, 0.1)
    bowl = np.exp(-((((pq[:, 0] + 1.0) / 8.5) ** 2 + ((pq[:, 1] + 3.0) / 10.5) ** 2) ** 1.5))
    fossa = np.exp(-(((pq[:, 0] - 4) / 6) ** 2 + ((pq[:, 1] - 17) / 5) ** 2))
    tragus = np.exp(-(((pq[:, 0] + 7.0) / 3.2) ** 2 + ((pq[:, 1] + 4) / 5.5) ** 2))
    anti = np.exp(-(((pq[:, 0] - 2) / 5) ** 2 + ((pq[:, 1] + 15) / 3) ** 2))
    crus = np.exp(-(((pq[:, 0] + 3) / 5) ** 2 + ((pq[:, 1] - 4) / 2.2) ** 2))
    return helix + ridge - 7.0 * bowl - 1.6 * fossa + 3.0 * tragus + 2.0 * anti + 1.2 * crus


def add_ear(half: HalfMesh) -> tuple[Array, Array]:
    """Add the left ear. Returns (attachment loop indices, their labels (N,2))."""
    rim = _outline()
    foot = np.stack(
        [np.where(rim[:, 0] > -2, -2 + 0.32 * (rim[:, 0] + 2), rim[:, 0]), rim[:, 1] * 0.8 - 0.5], 1
    )
    on_skin = _place(foot, np.zeros(_POINTS))
    attach = cast(on_skin, np.tile([1.0, 0.0, 0.0], (_POINTS, 1)))
    base = attach[:, 0]
    plane = np.linalg.lstsq(np.pad(foot, ((0, 0), (0, 1)), constant_values=1), base, rcond=None)[0]

    def side(pq: Array) -> Array:
        return pq @ plane[:2] + plane[2] + 0.6

    rim_x = side(rim) + _flare(rim)
    rows = [half.add(attach, "ear_foot")]
    label = np.stack(labels(attach), 1)
    half.label(rows[0], label)
    steps = []
    for f in (0.3, 0.62, 0.9):
        pq = foot + (f**1.35) * (rim - foot)
        steps.append(_place(pq, base + np.maximum(rim_x - 2.6 - base, 0.3) * f))
    for inset in (0.0, 0.06, 0.14, 0.22, 0.31, 0.42, 0.53, 0.65, 0.8, 0.92):
        pq = rim + inset * (_CONCHA - rim)
        level = np.full(_POINTS, inset)
        edge = 0.8 if inset == 0.0 else 0.0
        points = _place(pq, side(pq) + _flare(pq) + _relief(pq, level, rim) - edge)
        if inset < 0.3:  # outside the foot the ear must stay over the skin
            under = cast(points * [0, 1, 1], np.tile([1.0, 0.0, 0.0], (_POINTS, 1)))
            points[:, 0] = np.maximum(points[:, 0], under[:, 0] + 0.5 + 3 * inset)
        steps.append(points)
    for points in steps:
        rows.append(half.add(points, "ear"))
        half.strip("ear", rows[-2], rows[-1], closed=True)
    canal = _CONCHA[None]
    x = side(canal) + _flare(canal) + _relief(canal, np.ones(1), rim[:1]) - 1.0
    center = half.add(_place(canal, x), "ear")
    half.fan("ear", int(center[0]), rows[-1], closed=True)
    turn = rim - _CONCHA
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    for k, row in enumerate(rows):
        half.set_uv("ear", row, turn * (1 - k / len(rows)))
    half.set_uv("ear", center, np.zeros((1, 2)))
    half.tags["ear_rim"] = rows[4]
    return rows[0], label
