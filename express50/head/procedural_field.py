"""Signed field of the head's skin: anatomical masses joined by smooth minima, and casting on it.

Everything here is in millimetres, on the left half (x is folded to |x|): y up, z forward, origin
between the ears. Each mass is an ellipsoid or a tapered capsule placed by anthropometry (Farkas,
Anthropometry of the Head and Face, 1994: mean adult heights, breadths and depths).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Array = np.ndarray

EYE_CENTER = np.array([31.5, 20.0, 68.5])
EYE_RADIUS = 12.0
LID_RADIUS = 13.3


@dataclass(frozen=True)
class Mass:
    """One mass: kind "ellipsoid" (a centre, b radii) or "capsule" (a, b ends, radii at the ends)."""

    kind: str
    a: tuple[float, float, float]
    b: tuple[float, float, float]
    blend: float
    radii: tuple[float, float] = (0.0, 0.0)
    tilt: float = 0.0  # degrees about x (ellipsoids): positive tips the top forward
    yaw: float = 0.0  # degrees about y (ellipsoids): positive turns the front to the left
    carve: bool = False


def _ellipsoid(c: tuple, r: tuple, blend: float, *, tilt: float = 0.0, yaw: float = 0.0,
               carve: bool = False) -> Mass:
    return Mass("ellipsoid", c, r, blend, tilt=tilt, yaw=yaw, carve=carve)


def _capsule(a: tuple, b: tuple, ra: float, rb: float, blend: float, *,
             carve: bool = False) -> Mass:
    return Mass("capsule", a, b, blend, radii=(ra, rb), carve=carve)


SKULL = (
    _ellipsoid((0, 54, -20), (75, 79, 74), 1),
    _ellipsoid((0, 50, 22), (64, 80, 71), 28),
    _ellipsoid((0, 5, 38), (62, 62, 46), 25),
    _ellipsoid((0, -35, 44), (45, 42, 48), 22),  # maxilla and muscles around the mouth
    _capsule((46, 1, 60), (65, 3, 12), 11, 6, 14),  # cheekbone and zygomatic arch
    _capsule((16, -80, 75), (46, -60, 14), 12, 10, 12),  # body of the mandible
    _capsule((47, -58, 14), (58, -8, 6), 9, 9, 14),  # ramus
    _ellipsoid((0, -50, 30), (46, 38, 45), 16),
    _ellipsoid((0, -80, 80), (19, 13, 15), 12),  # chin
    _ellipsoid((0, -78, 42), (36, 22, 38), 14),  # floor of the mouth
    _ellipsoid((34, -22, 60), (22, 28, 24), 16),  # cheek fat
)
NECK = (
    _capsule((0, -70, -16), (0, -230, -34), 53, 55, 16),
    _capsule((55, -36, -22), (16, -215, 18), 7, 8, 18),  # sternocleidomastoid
    _capsule((14, -60, -60), (76, -196, -42), 14, 30, 30),  # trapezius
    _ellipsoid((0, -131, 30), (9, 13, 8), 14),  # thyroid cartilage
)
BROW_AND_ORBIT = (
    _capsule((10, 37, 86), (32, 43, 80), 8, 7.5, 10),
    _capsule((32, 43, 80), (52, 36, 60), 7.5, 6, 10),
    _ellipsoid((0, 37, 84), (14, 11, 11), 10),  # glabella
    _ellipsoid((32, 18, 91), (17, 12.5, 17), 9, carve=True, yaw=18),
    _ellipsoid((16, 24, 90), (7, 11, 12), 8, carve=True),
    _ellipsoid(tuple(EYE_CENTER), (LID_RADIUS,) * 3, 3.5),
)
NOSE = (
    _capsule((0, 26, 82), (0, -6, 98), 8, 9.5, 10),
    _ellipsoid((0, -8, 88), (15, 22, 16), 9),
    _ellipsoid((0, -14, 106), (10.5, 9.5, 10.5), 8),
    _ellipsoid((12.5, -18.5, 97), (7, 7.5, 10), 5, yaw=-15),
    _capsule((0, -26, 96), (0, -20, 109), 4.5, 5, 5),
)
LIPS = (
    _ellipsoid((0, -48, 80), (27, 22, 19), 10),  # dental arch behind the lips
    _capsule((4, -43.5, 96), (15, -45.5, 93.5), 5.2, 4.2, 4),
    _capsule((15, -45.5, 93.5), (27, -49, 84), 4.2, 2.5, 4),
    _capsule((0, -54.5, 95), (13, -54, 93), 5.6, 5.0, 4),
    _capsule((13, -54, 93), (27, -50, 84), 5.0, 2.5, 4),
    _capsule((0, -31, 104.5), (0, -41, 106.5), 3.5, 4, 3, carve=True),  # philtrum
    _capsule((0, -65, 102), (14, -66, 97), 6, 5, 7, carve=True),  # labiomental fold
)
MASSES = SKULL + NECK + BROW_AND_ORBIT + NOSE + LIPS


def _rotation(tilt: float, yaw: float) -> Array:
    a, b = np.radians(tilt), np.radians(yaw)
    rx = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    ry = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    return ry @ rx


def _distance(mass: Mass, p: Array) -> Array:
    if mass.kind == "ellipsoid":
        q = (p - np.asarray(mass.a, float)) @ _rotation(mass.tilt, mass.yaw)
        r = np.asarray(mass.b, float)
        q = q / r
        k0 = np.sqrt((q * q).sum(-1)) + 1e-12
        k1 = np.sqrt(((q / r) ** 2).sum(-1)) + 1e-12
        return k0 * (k0 - 1.0) / k1
    a, b = np.asarray(mass.a, float), np.asarray(mass.b, float)
    ab = b - a
    t = np.clip((p - a) @ ab / (ab @ ab), 0.0, 1.0)
    radius = mass.radii[0] + (mass.radii[1] - mass.radii[0]) * t
    return np.linalg.norm(p - a - t[:, None] * ab, axis=-1) - radius


def _smooth_min(a: Array, b: Array, k: float) -> Array:
    """Polynomial smooth minimum (quadratic), exact outside |a - b| < k."""
    h = np.maximum(k - np.abs(a - b), 0.0) / k
    return np.minimum(a, b) - 0.25 * k * h * h


def skin_field(points: Array, masses: tuple[Mass, ...] = MASSES) -> Array:
    """Signed distance-like value in mm at points (N,3) in mm: negative inside the skin."""
    p = np.asarray(points, float) * 1.0
    p[:, 0] = np.sqrt(p[:, 0] ** 2 + 1.0)  # folds without a crease on the mid plane
    value = _distance(masses[0], p)
    for mass in masses[1:]:
        d = _distance(mass, p)
        if mass.carve:
            value = -_smooth_min(-value, d, mass.blend)
        else:
            value = _smooth_min(value, d, mass.blend)
    return value


def cast(origins: Array, directions: Array, far: float = 170.0, steps: int = 56) -> Array:
    """Outermost hit (N,3) of the skin on rays from inside, marching inwards from `far` mm."""
    d = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    t = np.full(len(origins), far)
    for _ in range(steps):
        value = skin_field(origins + t[:, None] * d)
        t = np.maximum(t - 0.8 * value, 0.0)
    return origins + t[:, None] * d


def cast_out(origins: Array, directions: Array, steps: int = 30) -> Array:
    """First exit (N,3) from the skin on rays that start inside it."""
    d = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    t = np.zeros(len(origins))
    for _ in range(steps):
        t = t - 0.8 * skin_field(origins + t[:, None] * d)
    return origins + t[:, None] * d


def gradient(points: Array, step: float = 0.25) -> Array:
    """Unit outward normal (N,3) of the field by tetrahedral differences."""
    corners = np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], float)
    stacked = (points[None] + step * corners[:, None]).reshape(-1, 3)
    values = skin_field(stacked).reshape(4, -1)
    g = (corners[:, None] * values[..., None]).sum(0)
    return g / (np.linalg.norm(g, axis=-1, keepdims=True) + 1e-12)


def project(points: Array, iterations: int = 4) -> Array:
    """Points (N,3) moved to the skin along the field's gradient."""
    p = np.array(points, float)
    for _ in range(iterations):
        p = p - 0.9 * skin_field(p)[:, None] * gradient(p)
    return p
