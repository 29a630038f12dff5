"""Define the signed field of the head's skin, and cast the rays that sample it.

The field joins anatomical masses by smooth minima. Rays start on a bent central axis, and are
labelled by azimuth and latitude.

Everything is in millimetres, on the left half (x is folded to |x|): y up, z forward, origin between
the ears. Each mass is an ellipsoid or a tapered capsule placed by anthropometry (Farkas,
Anthropometry of the Head and Face, 1994: mean adult heights, breadths and depths).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator

from express50.geometry.transforms import unit

Array = np.ndarray

EYE_CENTER = np.array([31.5, 20.0, 70.0])
EYE_RADIUS = 12.0
LID_RADIUS = 13.3


@dataclass(frozen=True)
class Ellipsoid:
    """A mass by centre and radii, rotated by degrees; ``carve`` removes it."""

    centre: tuple[float, float, float]
    radii: tuple[float, float, float]
    blend: float
    tilt: float = 0.0  # about x: positive tips the top forward
    yaw: float = 0.0  # about y: positive turns the front to the left
    carve: bool = False


@dataclass(frozen=True)
class Capsule:
    """A mass by its ends and the radii there; ``carve`` removes it."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    start_radius: float
    end_radius: float
    blend: float
    carve: bool = False


MASSES: tuple[Ellipsoid | Capsule, ...] = (
    # skull
    Ellipsoid((0, 54, -20), (75, 79, 74), 1),
    Ellipsoid((0, 52, 24), (66, 78, 70), 28),
    Ellipsoid((0, 5, 38), (62, 60, 46), 25),
    Ellipsoid((0, -35, 46), (44, 42, 48), 22),  # maxilla and muscles around the mouth
    Capsule((44, 2, 62), (66, 4, 12), 11, 6, 14),  # cheekbone and zygomatic arch
    Capsule((10, -83, 78), (43, -60, 12), 10, 8.5, 18),  # body of the mandible
    Capsule((44, -58, 12), (57, -8, 6), 9, 9, 14),  # ramus
    Ellipsoid((0, -50, 32), (47, 39, 46), 16),
    Ellipsoid((0, -80, 82), (15, 13, 14), 12),  # chin
    Ellipsoid((0, -79, 38), (37, 23, 38), 14),  # floor of the mouth
    Ellipsoid((34, -24, 60), (21, 26, 24), 16),  # cheek fat
    Ellipsoid((28, -4, 76), (12, 9, 9), 14),  # front of the cheek, under the eye
    # neck
    Capsule((0, -70, -16), (0, -230, -34), 50, 52, 18),
    Ellipsoid((0, -18, -46), (46, 44, 33), 22),  # nuchal muscles
    Ellipsoid((56, -18, -22), (10, 18, 12), 12),  # mastoid
    Capsule((54, -36, -22), (15, -215, 16), 7, 8, 16),  # sternocleidomastoid
    Capsule((14, -60, -58), (82, -206, -42), 12, 27, 34),  # trapezius
    Ellipsoid((0, -102, 24), (24, 15, 16), 16),  # hyoid
    Ellipsoid((0, -131, 28), (8, 13, 8), 14),  # thyroid cartilage
    # brow and orbit
    Capsule((10, 37, 86), (30, 42, 78), 7, 6.5, 12),
    Capsule((30, 42, 78), (53, 35, 60), 6.5, 5.5, 12),
    Ellipsoid((0, 37, 84), (14, 11, 10.5), 12),  # glabella
    Ellipsoid((32, 15.0, 90), (16.5, 10.5, 14), 11, carve=True, yaw=18),
    Ellipsoid((33, 32.5, 71), (18, 6.0, 11.5), 6, yaw=22),  # fullness between lid and brow
    Ellipsoid((16.5, 22, 93.5), (5, 8, 8.5), 11, carve=True),
    Ellipsoid(tuple(EYE_CENTER), (LID_RADIUS,) * 3, 3.0),
    Capsule((20, 25.0, 85.0), (31, 28.8, 83.5), 1.4, 1.8, 2.5, carve=True),  # fold of the lid
    Capsule((31, 28.8, 83.5), (45, 24.5, 77), 1.8, 1.4, 2.5, carve=True),
    # nose
    Capsule((0, 26, 83), (0, -6, 99), 6.5, 8.5, 11),
    Ellipsoid((0, -8, 88), (14, 22, 16), 9),
    Ellipsoid((0, -14, 106.5), (9.5, 9, 10), 8),
    Ellipsoid((12.5, -19, 97.5), (6.5, 7, 10), 4, yaw=-15),
    Capsule((0, -26, 97), (0, -20, 109), 4.0, 5, 5),
    # lips
    Ellipsoid((0, -48, 80), (28, 22, 19), 10),  # dental arch behind the lips
    Capsule((3.5, -43.2, 98), (15, -45.0, 95), 5.4, 4.6, 4),
    Capsule((15, -45.0, 95), (27, -49, 84.5), 4.6, 2.0, 4),
    Capsule((0, -55, 97.0), (11, -54.6, 95.5), 6.0, 5.6, 5),
    Capsule((11, -54.6, 95.5), (26, -50, 84.5), 5.6, 2.0, 5),
    Capsule((0, -31, 105.5), (0, -40, 108), 3.5, 4, 3, carve=True),  # philtrum
    Capsule((0, -66.5, 103.5), (20, -67, 96), 6, 4.5, 10, carve=True),  # labiomental fold
    Ellipsoid((32, -50, 92), (5, 6, 7), 9, carve=True),  # hollow beside the mouth's corner
)


# All masses as arrays, so that one matrix product serves each kind.
_ROUND = [mass for mass in MASSES if isinstance(mass, Ellipsoid)]
_LONG = [mass for mass in MASSES if isinstance(mass, Capsule)]


def _to_unit_sphere(mass: Ellipsoid) -> Array:
    """Return the matrix (3,3) that maps directions, as rows, to the ellipsoid's unit sphere."""
    a, b = np.radians(mass.tilt), np.radians(mass.yaw)
    rx = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    ry = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    return ry @ rx / np.array(mass.radii, float)


_TO_SPHERES = np.concatenate([_to_unit_sphere(mass) for mass in _ROUND], 1)
_SHIFT = np.concatenate([np.array(mass.centre) @ _to_unit_sphere(mass) for mass in _ROUND])
_INVERSE_RADII = np.array([1 / np.array(mass.radii, float) for mass in _ROUND])
_START = np.array([mass.start for mass in _LONG], float)
_AXIS = np.array([np.subtract(mass.end, mass.start) for mass in _LONG], float)
_END_RADII = np.array([(mass.start_radius, mass.end_radius) for mass in _LONG], float)


def skin_field(points: Array) -> Array:
    """Return approximate signed distances (N,), mm, of points (N,3) from the skin, < 0 inside."""
    p = np.array(points, float)
    p[:, 0] = np.sqrt(p[:, 0] ** 2 + 1.0)  # folds without a crease on the mid plane
    # Distances to ellipsoids, first order near their surfaces.
    q = (p @ _TO_SPHERES - _SHIFT).reshape(len(p), -1, 3)
    k0 = np.sqrt(np.einsum("nec,nec->ne", q, q)) + 1e-12
    q *= _INVERSE_RADII
    k1 = np.sqrt(np.einsum("nec,nec->ne", q, q)) + 1e-12
    ellipsoids = iter(np.ascontiguousarray((k0 * (k0 - 1.0) / k1).T))
    # Distances to capsules, whose radius is linear between the ends.
    length2 = np.einsum("cd,cd->c", _AXIS, _AXIS)
    along = p @ _AXIS.T - np.einsum("cd,cd->c", _START, _AXIS)
    offset2 = (p * p).sum(1)[:, None] - 2 * p @ _START.T
    offset2 = offset2 + np.einsum("cd,cd->c", _START, _START)
    t = np.clip(along / length2, 0.0, 1.0)
    distance2 = offset2 - 2 * t * along + t * t * length2
    radius = _END_RADII[:, 0] + (_END_RADII[:, 1] - _END_RADII[:, 0]) * t
    capsules = iter(np.ascontiguousarray((np.sqrt(np.maximum(distance2, 0.0)) - radius).T))
    value = next(ellipsoids)
    for mass in MASSES[1:]:
        d = next(ellipsoids if isinstance(mass, Ellipsoid) else capsules)
        sign = -1.0 if mass.carve else 1.0
        # A quadratic smooth minimum, exact where the two differ by more than the blend.
        h = np.maximum(mass.blend - np.abs(sign * value - d), 0.0)
        value = sign * (np.minimum(sign * value, d) - (0.25 / mass.blend) * h * h)
    return value


def cast(origins: Array, directions: Array) -> Array:
    """Find the outermost hits (N,3) of rays with the skin, marching inwards from 170 mm."""
    d = unit(directions)
    t, active = np.full(len(origins), 170.0), np.arange(len(origins))
    for _ in range(70):
        value = skin_field(origins[active] + t[active, None] * d[active])
        t[active] = np.maximum(t[active] - 0.85 * value, 0.0)
        active = active[np.abs(value) > 5e-3]
        if not len(active):
            break
    return origins + t[:, None] * d


def from_front(xy: Array) -> Array:
    """Return the skin points (N,3) at front-view positions (N,2)."""
    origins = np.concatenate([xy, np.zeros((len(xy), 1))], 1)
    return cast(origins, np.tile([0.0, 0.0, 1.0], (len(xy), 1)))


def cast_out(origins: Array, directions: Array) -> Array:
    """Find where (N,3) rays that start inside the skin first leave it."""
    d = unit(directions)
    t = np.zeros(len(origins))
    for _ in range(30):
        t = t - 0.8 * skin_field(origins + t[:, None] * d)
    return origins + t[:, None] * d


def gradient(points: Array) -> Array:
    """Return unit outward normals (N,3) of the field from tetrahedral differences over 0.25 mm."""
    corners = np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], float)
    stacked = (points[None] + 0.25 * corners[:, None]).reshape(-1, 3)
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
_TABLE = np.array([
    (-85.0, -180, -22, -20), (-80.0, -165, -20, -22), (-66.0, -110, -10, -30),
    (-58.0, -72, -4, -45), (-51.0, -35, 0, -50), (-45.0, -29, 0, -38), (-40.0, -27, 0, -30),
    (-30.0, -13, 0, -20), (-20.0, -2, 0, -15), (-14.0, 2, 0, -10), (0.0, 20, 0, 0),
    (10.0, 30, 0, 8), (30.0, 38, 0, 30), (60.0, 40, 0, 61), (90.0, 40, 0, 90),
])  # fmt: skip
_CURVES = PchipInterpolator(_TABLE[:, 0], _TABLE[:, 1:])


def rays(azimuth: Array, latitude: Array) -> tuple[Array, Array]:
    """Return origins (N,3) mm and unit directions of azimuth (radians, 0 front), latitude (deg)."""
    y, z, elevation = _CURVES(np.asarray(latitude, float)).T
    return np.stack([np.zeros_like(y), y, z], -1), sphere(azimuth, elevation)


def labels(points: Array) -> tuple[Array, Array]:
    """Return azimuth (radians) and latitude (deg) of points (N,3), mm: the inverse of `rays`."""
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
    """Return the unit vectors (N,3) of labels, between which the skin is triangulated."""
    b = np.radians(latitude)
    return np.stack([np.cos(b) * np.sin(azimuth), np.sin(b), np.cos(b) * np.cos(azimuth)], -1)


def window(points: Array, at: ArrayLike, radius: ArrayLike) -> Array:
    """Return a Gaussian (N,) of points (N,D): 1 at `at` and exp(-1) at one radius."""
    return np.exp(-(((points - np.array(at)) / np.array(radius)) ** 2).sum(-1))
