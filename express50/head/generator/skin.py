"""Build the skin: loops around features, nostrils and ears, and graded points between them.

The half head is triangulated as the convex hull of its labels' directions on a sphere (a spherical
Delaunay triangulation), without the cap on the mid plane and the holes inside loops.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import map_coordinates
from scipy.spatial import ConvexHull, cKDTree
from skimage.measure import points_in_poly

from express50.geometry.transforms import unit
from express50.head.generator.features import add_eye_rings, add_lip_rings
from express50.head.generator.field import (
    BOTTOM_LATITUDE,
    cast,
    cast_out,
    labels,
    project,
    rays,
    sphere,
    window,
)
from express50.head.generator.mesh import HalfMesh, neighbour_mean

Array = np.ndarray

# x, y, z, radius of a dense core, spacing there, growth of spacing per mm beyond (all mm)
_DENSITY = np.array([
    (6, -15, 104, 14, 2.6, 0.12), (32, 20, 75, 22, 3.6, 0.10), (10, -48, 98, 30, 3.8, 0.10),
    (15, 40, 88, 22, 4.2, 0.10), (0, -85, 85, 20, 4.6, 0.10), (45, -62, 20, 20, 5.5, 0.10),
    (70, 5, -15, 30, 5.0, 0.12),
])  # fmt: skip
_COARSEST = 11.0


def spacing(points: Array) -> Array:
    """Return the wanted edge length (N,), mm, at points (N,3)."""
    d = np.linalg.norm(points[:, None] - _DENSITY[None, :, :3], axis=-1)
    h = _DENSITY[:, 4] + _DENSITY[:, 5] * np.maximum(d - _DENSITY[:, 3], 0.0)
    return np.minimum(h.min(1), _COARSEST)


def add_skin(half: HalfMesh) -> None:
    """Add all skin of the left half, with loops around eye, lips, nostril and ear."""
    rims = [add_eye_rings(half), add_nostril(half), add_ear(half), add_lip_rings(half)]
    *holes, lips = (half.labels[rim] for rim in rims)
    holes.append(np.concatenate([lips, [[0.0, lips[-1, 1]]]]))
    fixed = _add_midline(half, lips[0, 1], lips[-1, 1])
    index = np.concatenate([fixed, *rims])
    filled = _add_fill(half, half.points[index], holes)
    index = np.concatenate([index, filled])
    # The hull's triangles, without mid plane, end of the neck and insides of loops.
    label = half.labels[index]
    directions, flat = sphere(*label.T), np.abs(np.sin(label[:, 0])) < 1e-9
    directions[flat, 0] = 0.0
    faces = ConvexHull(directions).simplices
    drop = flat[faces].all(1) | (np.abs(label[:, 1] - BOTTOM_LATITUDE) < 1e-6)[faces].all(1)
    start = len(fixed)
    for rim in rims:
        member = np.zeros(len(label), bool)
        member[start : start + len(rim)] = True
        drop |= member[faces].all(1)
        start += len(rim)
    faces = index[faces[~drop]]
    half.add_faces("skin", faces)
    half.tags["grid"] = index
    # Filled vertices and their labels move towards their neighbours' means, on the skin.
    points, direction = half.points, sphere(*np.nan_to_num(half.labels).T)
    for _ in range(6):
        points[filled] += 0.6 * (neighbour_mean(points, faces) - points)[filled]
        points[filled] = project(points[filled], 1)
        direction[filled] += 0.6 * (neighbour_mean(direction, faces) - direction)[filled]
    points[filled] = project(points[filled], 3)
    x, y, z = unit(direction[filled]).T
    half.labels[filled] = np.stack([np.arctan2(x, z), np.degrees(np.arcsin(y))], 1)


def _add_midline(half: HalfMesh, lip_top: float, lip_bottom: float) -> Array:
    """Add vertices on the mid plane, from upper lip to nape and below the lips, and a collar."""
    groups = []
    for azimuth, low, high in (
        (0.0, lip_top, 90.0),
        (np.pi, BOTTOM_LATITUDE, 90.0),
        (0.0, BOTTOM_LATITUDE, lip_bottom),
    ):
        latitude = np.linspace(low, high, 400)
        points = cast(*rays(np.full(400, azimuth), latitude))
        step = np.linalg.norm(np.diff(points, axis=0), axis=1)
        count = np.concatenate([[0], np.cumsum(step / spacing(points[1:]))])
        n = int(np.ceil(count[-1]))
        pick = np.interp(np.arange(n + 1) * count[-1] / n, count, latitude)
        # The loop of the lips has the ends there already, and the front line has the crown.
        pick = pick[1:] if low == lip_top else pick[:-1]
        points = cast(*rays(np.full(len(pick), azimuth), pick))
        points[:, 0] = 0.0
        groups.append(half.add(points, "midline"))
        half.labels[groups[-1]] = np.stack([np.full(len(pick), azimuth), pick], 1)
    around = np.linspace(0, np.pi, 26)[1:-1]
    collar = np.stack([around, np.full(len(around), BOTTOM_LATITUDE)], 1)
    groups.append(half.add(cast(*rays(*collar.T)), "collar"))
    half.labels[groups[-1]] = collar
    half.tags["collar"] = np.concatenate([groups[-1], groups[1][:1], groups[2][:1]])
    return np.concatenate(groups)


def _add_fill(half: HalfMesh, fixed: Array, holes: list[Array]) -> Array:
    """Add graded random points (seeded dart throwing) outside all loops; return their indices."""
    azimuth, latitude = np.linspace(0, np.pi, 61), np.linspace(BOTTOM_LATITUDE, 90, 69)
    a, b = np.meshgrid(azimuth, latitude, indexing="ij")
    table = cast(*rays(a.ravel(), b.ravel())).reshape(61, 69, 3)
    rng = np.random.default_rng(50)
    label = rng.random((24000, 2))
    # Even on the sphere.
    label = np.stack([np.pi * label[:, 0], np.degrees(np.arcsin(2 * label[:, 1] - 1))], 1)
    more = rng.random((16000, 2)) * [1.2, 90.0] + [0.0, -60.0]
    label = np.concatenate([label, more])
    label = label[label[:, 1] > BOTTOM_LATITUDE + 1]
    grid = np.stack([label[:, 0] / np.pi * 60, (label[:, 1] + 80) / 170 * 68])
    points = np.stack([map_coordinates(table[..., k], grid, order=1) for k in range(3)], 1)
    h = spacing(points)
    keep = points[:, 0] > 0.6 * h
    for hole in holes:
        keep &= ~points_in_poly(label, hole)
    keep[keep] = cKDTree(fixed).query(points[keep])[0] > 0.72 * h[keep]
    points, label, h = points[keep], label[keep], h[keep]
    tree, alive, chosen = cKDTree(points), np.ones(len(points), bool), []
    for i in range(len(points)):
        if alive[i]:
            chosen.append(i)
            alive[tree.query_ball_point(points[i], 0.86 * h[i])] = False
    index = half.add(cast(*rays(*label[chosen].T)), "fill")
    half.labels[index] = label[chosen]
    return index


def set_skin_uv(half: HalfMesh) -> None:
    """Set the skin's chart: pseudo-cylindrical, cut along the back, with more room in front."""
    index = np.flatnonzero(np.isfinite(half.labels[:, 0]))
    azimuth, latitude = half.labels[index].T
    width = np.interp(
        latitude,
        [-85, -80, -60, -42, -15, 15, 40, 60, 75, 84, 90],
        [0.8, 0.78, 0.74, 0.92, 1.0, 1.0, 0.84, 0.56, 0.3, 0.14, 0.0],
    )
    u = (azimuth / np.pi + 0.19 * np.sin(azimuth)) * width
    v = np.interp(latitude, [-85, -80, -52, -45, 45, 90], [-0.06, 0.0, 0.11, 0.17, 0.80, 1.0])
    half.set_uv("skin", index, np.stack([u, v], 1))


_INSIDE = np.array([7.0, -16.0, 105.0])  # the point above the nostril from which loops are cast
_DOWN = np.array([0.05, -0.97, 0.2])
_LONG = np.array([-0.24, 0.2, 0.95])  # from the ala's base towards the tip
_NOSTRIL_POINTS = 14


def add_nostril(half: HalfMesh) -> Array:
    """Add the left nostril; return the indices (N,) of its outer loop."""
    down = _DOWN / np.linalg.norm(_DOWN)
    side = np.cross(_LONG, down)
    side /= np.linalg.norm(side)
    long = np.cross(down, side)
    turn = 2 * np.pi * np.arange(_NOSTRIL_POINTS) / _NOSTRIL_POINTS
    rings = []
    for a, b in ((0.66, 0.5), (0.52, 0.36), (0.42, 0.27)):  # half widths per mm of distance
        d = down + np.outer(np.cos(turn) * a, long) + np.outer(np.sin(turn) * b, side)
        rings.append(cast_out(np.tile(_INSIDE, (_NOSTRIL_POINTS, 1)), d))
    middle = rings[-1].mean(0)
    for shrink, lift in ((0.88, 1.6), (0.7, 4.5), (0.45, 7.5)):
        rings.append(middle + shrink * (rings[2] - middle) - lift * down)
    label = np.stack(labels(rings[0]), 1)
    center = label.mean(0)
    rows = []
    for k, (ring, f) in enumerate(zip(rings, (1, 0.85, 0.7, 0.55, 0.4, 0.2), strict=True)):
        rows.append(half.add(ring, f"nostril{k}"))
        half.labels[rows[-1]] = center + f * (label - center)
        if k:
            half.strip("skin", rows[-1], rows[-2], closed=True)
    top = half.add((middle - 9.0 * down)[None], "nostril_top")
    half.labels[top] = center
    half.fan("skin", top, rows[-1], closed=True)
    return rows[0]


EAR_CENTER = np.array([7.0, -15.0])  # (y, z) of the ear's own origin, mm
EAR_TILT = np.radians(12.0)  # the ear's long axis leans back
_EAR_POINTS = 40
# Outline (backwards, up) in mm from the helix's root over the top to lobe and tragus.
_OUTLINE = np.array([
    (-7.5, 8), (-6.5, 20), (0, 29), (9, 32), (18, 28.5), (23.5, 18), (23, 5), (18, -8),
    (11.5, -18), (5.5, -26.5), (-1, -30.5), (-6.5, -27), (-8.5, -18), (-9.5, -9), (-9.5, 0),
])  # fmt: skip
_CONCHA = np.array([-1.5, -4.0])


def _place(pq: Array, x: Array) -> Array:
    """Return the points (N,3) in head space of ear-plane coordinates (backwards, up) and x."""
    c, s = np.cos(EAR_TILT), np.sin(EAR_TILT)
    back = c * pq[:, 0] + s * pq[:, 1]
    up = -s * pq[:, 0] + c * pq[:, 1]
    return np.stack([x, EAR_CENTER[0] + up, EAR_CENTER[1] - back], 1)


def _flare(pq: Array) -> Array:
    """Return the distance (N,), mm, of the ear's plane from the side of the head."""
    back = np.logaddexp(0.0, 0.35 * (pq[:, 0] + 5.0)) / 0.35  # a smooth max(0, p + 5)
    return 0.5 + 0.5 * back - 0.0016 * pq[:, 1] ** 2


def _relief(pq: Array, inset: Array, rim: Array) -> Array:
    """Return the front's height (N,), mm: helix, scapha, antihelix, concha, tragus, lobe."""
    back_top = 1 / (1 + np.exp(-(rim[:, 0] * 0.35 + rim[:, 1] * 0.12 - 0.2)))
    inset = inset[:, None]
    helix = back_top * (2.6 * window(inset, 0.06, 0.07) - 2.0 * window(inset, 0.24, 0.09))
    ridge = 2.6 * back_top * window(inset, 0.44, 0.1)
    bowl = np.exp(-((((pq[:, 0] + 1.0) / 8.5) ** 2 + ((pq[:, 1] + 3.0) / 10.5) ** 2) ** 1.5))
    fossa, tragus = window(pq, (4, 17), (6, 5)), window(pq, (-7, -4), (3.2, 5.5))
    anti, crus = window(pq, (2, -15), (5, 3)), window(pq, (-3, 4), (5, 2.2))
    return helix + ridge - 7.0 * bowl - 1.6 * fossa + 3.0 * tragus + 2.0 * anti + 1.2 * crus


def add_ear(half: HalfMesh) -> Array:
    """Add the left ear; return the indices (N,) of the loop that joins it to the head."""
    closed = np.concatenate([_OUTLINE, _OUTLINE[:1]])
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    curve = CubicSpline(length, closed, bc_type="periodic")
    rim = curve(np.linspace(0, length[-1], _EAR_POINTS, endpoint=False))
    foot = np.stack(
        [np.where(rim[:, 0] > -2, -2 + 0.32 * (rim[:, 0] + 2), rim[:, 0]), rim[:, 1] * 0.8 - 0.5], 1
    )
    on_skin = _place(foot, np.zeros(_EAR_POINTS))
    attach = cast(on_skin, np.tile([1.0, 0.0, 0.0], (_EAR_POINTS, 1)))
    base = attach[:, 0]
    plane = np.linalg.lstsq(np.pad(foot, ((0, 0), (0, 1)), constant_values=1), base, rcond=None)[0]

    def side(pq: Array) -> Array:
        return pq @ plane[:2] + plane[2] + 0.6

    rim_x = side(rim) + _flare(rim)
    rows = [half.add(attach, "ear_foot")]
    half.labels[rows[0]] = np.stack(labels(attach), 1)
    steps = []
    for f in (0.3, 0.62, 0.9):
        pq = foot + (f**1.35) * (rim - foot)
        steps.append(_place(pq, base + np.maximum(rim_x - 2.6 - base, 0.3) * f))
    for inset in (0.0, 0.06, 0.14, 0.22, 0.31, 0.42, 0.53, 0.65, 0.8, 0.92):
        pq = rim + inset * (_CONCHA - rim)
        level = np.full(_EAR_POINTS, inset)
        edge = 0.8 if inset == 0.0 else 0.0
        points = _place(pq, side(pq) + _flare(pq) + _relief(pq, level, rim) - edge)
        if inset < 0.3:  # outside its foot the ear must stay above the skin
            under = cast(points * [0, 1, 1], np.tile([1.0, 0.0, 0.0], (_EAR_POINTS, 1)))
            points[:, 0] = np.maximum(points[:, 0], under[:, 0] + 0.5 + 3 * inset)
        steps.append(points)
    for points in steps:
        rows.append(half.add(points, "ear"))
        half.strip("ear", rows[-2], rows[-1], closed=True)
    canal = _CONCHA[None]
    x = side(canal) + _flare(canal) + _relief(canal, np.ones(1), rim[:1]) - 1.0
    center = half.add(_place(canal, x), "ear")
    half.fan("ear", center, rows[-1], closed=True)
    turn = unit(rim - _CONCHA)
    for k, row in enumerate(rows):
        half.set_uv("ear", row, turn * (1 - k / len(rows)))
    half.set_uv("ear", center, np.zeros((1, 2)))
    return rows[0]
