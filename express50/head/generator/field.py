"""Signed field of the head's skin, and the rays that sample it.

The field joins anatomical masses by smooth minima. The rays leave a bent central axis; their
labels are azimuth and latitude.

Everything is in millimetres, on the left half (x is folded to |x|): y up, z forward, origin
between the ears. Each mass is an ellipsoid or a tapered capsule placed by anthropometry (Farkas,
Anthropometry of the Head and Face, 1994: mean adult heights, breadths and depths).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator

Array = np.ndarray

EYE_CENTER = np.array([31.5, 20.0, 70.0])
EYE_RADIUS = 12.0
LID_RADIUS = 13.3


@dataclass(frozen=True)
class Mass:
    """One mass: kind "ellipsoid" (a centre, b radii) or "capsule" (a, b ends)."""

    kind: str
    a: tuple[float, float, float]
    b: tuple[float, float, float]
    blend: float
    radii: tuple[float, float] = (0.0, 0.0)
    tilt: float = 0.0  # degrees about x (ellipsoids): positive tips the top forward
    yaw: float = 0.0  # degrees about y (ellipsoids): positive turns the front to the left
    carve: bool = False


def _ellipsoid(
    c: tuple, r: tuple, blend: float, *, tilt: float = 0.0, yaw: float = 0.0, carve: bool = False
) -> Mass:
    return Mass("ellipsoid", c, r, blend, tilt=tilt, yaw=yaw, carve=carve)


def _capsule(
    a: tuple, b: tuple, ra: float, rb: float, blend: float, *, carve: bool = False
) -> Mass:
    return Mass("capsule", a, b, blend, radii=(ra, rb), carve=carve)


SKULL = (
    _ellipsoid((0, 54, -20), (75, 79, 74), 1),
    _ellipsoid((0, 52, 24), (66, 78, 70), 28),
    _ellipsoid((0, 5, 38), (62, 60, 46), 25),
    _ellipsoid((0, -35, 46), (44, 42, 48), 22),  # maxilla and muscles around the mouth
    _capsule((44, 2, 62), (66, 4, 12), 11, 6, 14),  # cheekbone and zygomatic arch
    _capsule((10, -83, 78), (43, -60, 12), 10, 8.5, 18),  # body of the mandible
    _capsule((44, -58, 12), (57, -8, 6), 9, 9, 14),  # ramus
    _ellipsoid((0, -50, 32), (47, 39, 46), 16),
    _ellipsoid((0, -80, 82), (15, 13, 14), 12),  # chin
    _ellipsoid((0, -79, 38), (37, 23, 38), 14),  # floor of the mouth
    _ellipsoid((34, -24, 60), (21, 26, 24), 16),  # cheek fat
    _ellipsoid((28, -4, 76), (12, 9, 9), 14),  # front of the cheek, under the eye
)
NECK = (
    _capsule((0, -70, -16), (0, -230, -34), 50, 52, 18),
    _ellipsoid((0, -18, -46), (46, 44, 33), 22),  # nuchal muscles
    _ellipsoid((56, -18, -22), (10, 18, 12), 12),  # mastoid
    _capsule((54, -36, -22), (15, -215, 16), 7, 8, 16),  # sternocleidomastoid
    _capsule((14, -60, -58), (82, -206, -42), 12, 27, 34),  # trapezius
    _ellipsoid((0, -102, 24), (24, 15, 16), 16),  # hyoid
    _ellipsoid((0, -131, 28), (8, 13, 8), 14),  # thyroid cartilage
)
BROW_AND_ORBIT = (
    _capsule((10, 37, 86), (30, 42, 78), 7, 6.5, 12),
    _capsule((30, 42, 78), (53, 35, 60), 6.5, 5.5, 12),
    _ellipsoid((0, 37, 84), (14, 11, 10.5), 12),  # glabella
    _ellipsoid((32, 15.0, 90), (16.5, 10.5, 14), 11, carve=True, yaw=18),
    _ellipsoid((33, 32.5, 71), (18, 6.0, 11.5), 6, yaw=22),  # fullness between lid and brow
    _ellipsoid((16.5, 22, 93.5), (5, 8, 8.5), 11, carve=True),
    _ellipsoid(tuple(EYE_CENTER), (LID_RADIUS,) * 3, 3.0),
    _capsule((20, 25.0, 85.0), (31, 28.8, 83.5), 1.4, 1.8, 2.5, carve=True),  # fold of the lid
    _capsule((31, 28.8, 83.5), (45, 24.5, 77), 1.8, 1.4, 2.5, carve=True),
)
NOSE = (
    _capsule((0, 26, 83), (0, -6, 99), 6.5, 8.5, 11),
    _ellipsoid((0, -8, 88), (14, 22, 16), 9),
    _ellipsoid((0, -14, 106.5), (9.5, 9, 10), 8),
    _ellipsoid((12.5, -19, 97.5), (6.5, 7, 10), 4, yaw=-15),
    _capsule((0, -26, 97), (0, -20, 109), 4.0, 5, 5),
)
LIPS = (
    _ellipsoid((0, -48, 80), (28, 22, 19), 10),  # dental arch behind the lips
    _capsule((3.5, -43.2, 98), (15, -45.0, 95), 5.4, 4.6, 4),
    _capsule((15, -45.0, 95), (27, -49, 84.5), 4.6, 2.0, 4),
    _capsule((0, -55, 97.0), (11, -54.6, 95.5), 6.0, 5.6, 5),
    _capsule((11, -54.6, 95.5), (26, -50, 84.5), 5.6, 2.0, 5),
    _capsule((0, -31, 105.5), (0, -40, 108), 3.5, 4, 3, carve=True),  # philtrum
    _capsule((0, -66.5, 103.5), (20, -67, 96), 6, 4.5, 10, carve=True),  # labiomental fold
    _ellipsoid((32, -50, 92), (5, 6, 7), 9, carve=True),  # hollow beside the mouth's corner
)
MASSES = SKULL + NECK + BROW_AND_ORBIT + NOSE + LIPS


def _rotation(tilt: float, yaw: float) -> Array:
    a, b = np.radians(tilt), np.radians(yaw)
    rx = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    ry = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    return ry @ rx


@dataclass(frozen=True)
class _Stack:
    """Masses as arrays, so that one matrix product serves all of them."""

    unit: Array  # (3,3E) head space to the ellipsoids' unit spheres
    shift: Array  # (3E,)
    inverse_radii: Array  # (E,3)
    start: Array  # (C,3) capsules: first end, axis, radii
    axis: Array
    radii: Array
    order: tuple[tuple[bool, int, float, bool], ...]  # is ellipsoid, index, blend, carve


def _stack(masses: tuple[Mass, ...]) -> _Stack:
    round_ones = [m for m in masses if m.kind == "ellipsoid"]
    long_ones = [m for m in masses if m.kind == "capsule"]
    units = [_rotation(m.tilt, m.yaw) / np.array(m.b, float) for m in round_ones]
    order, counts = [], {"ellipsoid": 0, "capsule": 0}
    for m in masses:
        order.append((m.kind == "ellipsoid", counts[m.kind], m.blend, m.carve))
        counts[m.kind] += 1
    return _Stack(
        unit=np.concatenate(units, 1),
        shift=np.concatenate([np.array(m.a) @ u for m, u in zip(round_ones, units, strict=True)]),
        inverse_radii=np.array([1 / np.array(m.b, float) for m in round_ones]),
        start=np.array([m.a for m in long_ones], float),
        axis=np.array([np.subtract(m.b, m.a) for m in long_ones], float),
        radii=np.array([m.radii for m in long_ones], float),
        order=tuple(order),
    )


_SKIN = _stack(MASSES)


def _ellipsoid_distances(stack: _Stack, p: Array) -> Array:
    """Return distances (N,E), first order near the surfaces."""
    q = (p @ stack.unit - stack.shift).reshape(len(p), -1, 3)
    k0 = np.sqrt(np.einsum("nec,nec->ne", q, q)) + 1e-12
    q *= stack.inverse_radii
    k1 = np.sqrt(np.einsum("nec,nec->ne", q, q)) + 1e-12
    return k0 * (k0 - 1.0) / k1


def _capsule_distances(stack: _Stack, p: Array) -> Array:
    """Return distances (N,C) to capsules whose radius runs linearly between the ends."""
    length2 = np.einsum("cd,cd->c", stack.axis, stack.axis)
    along = p @ stack.axis.T - np.einsum("cd,cd->c", stack.start, stack.axis)
    offset2 = (p * p).sum(1)[:, None] - 2 * p @ stack.start.T
    offset2 = offset2 + np.einsum("cd,cd->c", stack.start, stack.start)
    t = np.clip(along / length2, 0.0, 1.0)
    distance2 = offset2 - 2 * t * along + t * t * length2
    radius = stack.radii[:, 0] + (stack.radii[:, 1] - stack.radii[:, 0]) * t
    return np.sqrt(np.maximum(distance2, 0.0)) - radius


def _smooth_min(a: Array, b: Array, k: float) -> Array:
    """Take the polynomial smooth minimum (quadratic), exact outside |a - b| < k."""
    h = np.maximum(k - np.abs(a - b), 0.0)
    return np.minimum(a, b) - (0.25 / k) * h * h


def skin_field(points: Array) -> Array:
    """Compute a signed distance-like value, mm, at points (N,3) mm: negative inside the skin."""
    p = np.array(points, float)
    p[:, 0] = np.sqrt(p[:, 0] ** 2 + 1.0)  # folds without a crease on the mid plane
    ellipsoids = np.ascontiguousarray(_ellipsoid_distances(_SKIN, p).T)
    capsules = np.ascontiguousarray(_capsule_distances(_SKIN, p).T)
    value = ellipsoids[0]
    for is_ellipsoid, index, blend, carve in _SKIN.order[1:]:
        d = ellipsoids[index] if is_ellipsoid else capsules[index]
        value = -_smooth_min(-value, d, blend) if carve else _smooth_min(value, d, blend)
    return value


def cast(origins: Array, directions: Array, far: float = 170.0, steps: int = 70) -> Array:
    """Find the outermost hit (N,3) of the skin on rays, marching inwards from `far` mm."""
    d = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    t, active = np.full(len(origins), far), np.arange(len(origins))
    for _ in range(steps):
        value = skin_field(origins[active] + t[active, None] * d[active])
        t[active] = np.maximum(t[active] - 0.85 * value, 0.0)
        active = active[np.abs(value) > 5e-3]
        if not len(active):
            break
    return origins + t[:, None] * d


def cast_out(origins: Array, directions: Array, steps: int = 30) -> Array:
    """Find the first exit (N,3) from the skin on rays that start inside it."""
    d = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    t = np.zeros(len(origins))
    for _ in range(steps):
        t = t - 0.8 * skin_field(origins + t[:, None] * d)
    return origins + t[:, None] * d


def gradient(points: Array, step: float = 0.25) -> Array:
    """Return unit outward normal (N,3) of the field by tetrahedral differences."""
    corners = np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], float)
    stacked = (points[None] + step * corners[:, None]).reshape(-1, 3)
    values = skin_field(stacked).reshape(4, -1)
    g = (corners[:, None] * values[..., None]).sum(0)
    return g / (np.linalg.norm(g, axis=-1, keepdims=True) + 1e-12)


def project(points: Array, iterations: int = 4) -> Array:
    """Move points (N,3) to the skin along the field's gradient."""
    p = np.array(points, float)
    for _ in range(iterations):
        p = p - 0.9 * skin_field(p)[:, None] * gradient(p)
    return p


BOTTOM_LATITUDE = -80.0
#         latitude, origin y, origin z, elevation
_TABLE = np.array(
    [
        (-85.0, -180, -22, -20),
        (-80.0, -165, -20, -22),
        (-66.0, -110, -10, -30),
        (-58.0, -72, -4, -45),
        (-51.0, -35, 0, -50),
        (-45.0, -29, 0, -38),
        (-40.0, -27, 0, -30),
        (-30.0, -13, 0, -20),
        (-20.0, -2, 0, -15),
        (-14.0, 2, 0, -10),
        (0.0, 20, 0, 0),
        (10.0, 30, 0, 8),
        (30.0, 38, 0, 30),
        (60.0, 40, 0, 61),
        (90.0, 40, 0, 90),
    ]
)
_CURVES = PchipInterpolator(_TABLE[:, 0], _TABLE[:, 1:])


def rays(azimuth: Array, latitude: Array) -> tuple[Array, Array]:
    """Origins and unit directions (N,3) in mm for azimuth (radians, 0 front) and latitude (deg)."""
    y, z, elevation = _CURVES(np.asarray(latitude, float)).T
    e = np.radians(elevation)
    origins = np.stack([np.zeros_like(y), y, z], -1)
    directions = np.stack([np.cos(e) * np.sin(azimuth), np.sin(e), np.cos(e) * np.cos(azimuth)], -1)
    return origins, directions


def labels(points: Array) -> tuple[Array, Array]:
    """Return azimuth (radians) and latitude (deg) of points (N,3) in mm: the inverse of `rays`."""
    low, high = np.full(len(points), -85.0), np.full(len(points), 89.9)
    for _ in range(40):
        middle = 0.5 * (low + high)
        y, z, elevation = _CURVES(middle).T
        rho = np.hypot(points[:, 0], points[:, 2] - z)
        above = points[:, 1] > y + rho * np.tan(np.radians(elevation))
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    latitude = 0.5 * (low + high)
    z = _CURVES(latitude)[:, 1]
    return np.arctan2(points[:, 0], points[:, 2] - z), latitude


def sphere(azimuth: Array, latitude: Array) -> Array:
    """Return unit vectors (N,3) of the labels, the domain in which the skin is triangulated."""
    b = np.radians(latitude)
    return np.stack([np.cos(b) * np.sin(azimuth), np.sin(b), np.cos(b) * np.cos(azimuth)], -1)
