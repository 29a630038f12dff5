"""Build eyelid loops, the lids' hidden edges, the lids' motions, and the eyeballs."""

from __future__ import annotations

import numpy as np

from express50.geometry.transforms import unit
from express50.head.generator.field import EYE_CENTER, EYE_RADIUS, LID_RADIUS, cast, labels
from express50.head.generator.mesh import HalfMesh, WholeMesh

Array = np.ndarray

LID_SEGMENTS = 20
INNER_CANTHUS = np.array([17.4, 18.2])
OUTER_CANTHUS = np.array([45.8, 20.6])
_ORBIT_CENTER, _ORBIT_RADII = np.array([32.0, 20.5]), np.array([21.5, 17.5])
_FRACTIONS = (0.0, 0.09, 0.2, 0.33, 0.48, 0.65, 0.82, 1.0)
IRIS_RADIUS, PUPIL_RADIUS = 5.9, 1.9


def lid_margin() -> Array:
    """Return the lid margin (40,2), front view, mm: upper lid outwards, lower lid back."""
    s = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, LID_SEGMENTS + 1))
    line = INNER_CANTHUS + s[:, None] * (OUTER_CANTHUS - INNER_CANTHUS)
    upper, lower = line.copy(), line.copy()
    upper[:, 1] += 5.1 * np.abs(np.sin(np.pi * s**0.88)) ** 0.8
    lower[:, 1] -= 5.0 * np.abs(np.sin(np.pi * s**1.12)) ** 0.85
    return np.concatenate([upper, lower[-2:0:-1]])


def from_front(xy: Array) -> Array:
    """Return the skin points (N,3) at front-view positions (N,2)."""
    origins = np.concatenate([xy, np.zeros((len(xy), 1))], 1)
    return cast(origins, np.tile([0.0, 0.0, 1.0], (len(xy), 1)))


def add_eye_rings(half: HalfMesh) -> Array:
    """Add lid loops out to the orbit's rim; return the indices of the outer one."""
    margin = lid_margin()
    angle = np.pi - np.pi * np.arange(2 * LID_SEGMENTS) / LID_SEGMENTS
    outer = _ORBIT_CENTER + _ORBIT_RADII * np.stack([np.cos(angle), np.sin(angle)], 1)
    rings = [from_front(margin + f * (outer - margin)) for f in _FRACTIONS]
    outer_label = np.stack(labels(rings[-1]), 1)
    margin_label = np.stack(labels(rings[0]), 1)
    indices = [half.add(ring, f"lid{k}") for k, ring in enumerate(rings)]
    for index, f in zip(indices, _FRACTIONS, strict=True):
        half.labels[index] = margin_label + f * (outer_label - margin_label)
    for inner, out in zip(indices[:-1], indices[1:], strict=True):
        half.strip("skin", inner, out, closed=True)
    # The lid's thickness: an edge down to the eyeball, then a strip hidden under the lid.
    points = rings[0]
    away = points - EYE_CENTER
    edge = EYE_CENTER + away * (EYE_RADIUS + 0.15) / np.linalg.norm(away, axis=1, keepdims=True)
    away_xy = unit(points[:, :2] - points[:, :2].mean(0))
    hidden = edge + np.pad(away_xy * 4.0, ((0, 0), (0, 1))) - EYE_CENTER
    hidden = EYE_CENTER + hidden * (EYE_RADIUS + 0.2) / np.linalg.norm(hidden, axis=1)[:, None]
    middle = margin_label.mean(0)
    rows = [indices[0]]
    for tag, ring, share in (("lid_edge", edge, 0.86), ("lid_hidden", hidden, 0.6)):
        rows.append(half.add(ring, tag))
        half.labels[rows[-1]] = middle + share * (margin_label - middle)
        half.strip("skin", rows[-2], rows[-1], closed=True)
    return indices[-1]


def add_eyeball(half: HalfMesh) -> None:
    """Add a sphere of two charts, with rings at the rims of pupil and iris."""
    iris = np.degrees(np.arcsin(IRIS_RADIUS / EYE_RADIUS))
    pupil = np.degrees(np.arcsin(PUPIL_RADIUS / EYE_RADIUS))
    polar = np.radians([pupil, pupil + 2, 0.5 * (pupil + iris), iris, iris + 2,
                        42, 54, 66, 78, 90, 110, 130, 150, 167])  # fmt: skip
    turn = 2 * np.pi * np.arange(28) / 28
    circle = np.stack([np.cos(turn), np.sin(turn)], 1)
    front = half.add(EYE_CENTER + [[0, 0, EYE_RADIUS]], "eyeball")
    rings = []
    for k, a in enumerate(polar):
        ring = np.concatenate([np.sin(a) * circle, np.full((28, 1), np.cos(a))], 1)
        rings.append(half.add(EYE_CENTER + EYE_RADIUS * ring, "eyeball"))
        if k <= 9:
            half.set_uv("eye_front", rings[-1], circle * a / np.pi)
        if k >= 9:
            half.set_uv("eye_back", rings[-1], circle * [-1, 1] * (np.pi - a) / np.pi)
    back = half.add(EYE_CENTER - [[0, 0, EYE_RADIUS]], "eyeball")
    pole = np.zeros((1, 2))
    half.set_uv("eye_front", front, pole)
    half.set_uv("eye_back", back, pole)
    half.fan("eye_front", front, rings[0], closed=True)
    half.fan("eye_back", back, rings[-1], closed=True)
    for k in range(len(rings) - 1):
        half.strip("eye_front" if k < 9 else "eye_back", rings[k], rings[k + 1], closed=True)
    half.tags["pupil"] = np.concatenate([front, rings[0]])
    half.tags["iris"] = np.concatenate([front, *rings[:4]])


def ball_centre(mesh: WholeMesh, side: str) -> Array:
    """Return the centre (3,) of an eyeball, mm: halfway between its poles."""
    ball = mesh.vertices[mesh.tag("eyeball", side)]
    return 0.5 * (ball[0] + ball[-1])


_STILL = 5  # the lid loop that does not move; loops inside it share the margin's motion


def lid_motion(mesh: WholeMesh, upper: float, lower: float) -> Array:
    """Return the displacement (V,3), mm, that moves the left lid margins by shares of the opening.

    Loops between the margin and the still loop are spread evenly over the stretched lid, as they
    turn about the eyeball's centre, and the upper lid's fold is smoothed onto the lid's sphere.
    `upper` is the share of the opening that the upper margin moves down, `lower` the share that the
    lower one moves up.
    """
    center = ball_centre(mesh, "left")
    rings = [mesh.tag(f"lid{k}", "left") for k in range(_STILL + 1)]
    loops = mesh.vertices[np.stack(rings)] - center
    margin = loops[0]
    count = len(margin)
    opposite = margin[(-np.arange(count)) % count]
    is_upper = np.arange(count) <= LID_SEGMENTS
    height = margin[:, 1] + np.where(is_upper, upper, lower) * (opposite[:, 1] - margin[:, 1])
    radius = np.hypot(loops[..., 1], loops[..., 2])
    angle = np.arctan2(loops[..., 1], loops[..., 2])
    span = angle[0] - angle[_STILL]
    span = np.where(np.abs(span) > 0.02, span, np.inf)
    open_here = np.abs(margin[:, 1] - opposite[:, 1])
    drawn = max(upper, 0.0) * np.where(is_upper, open_here / open_here.max(), 0.0)
    shell = np.sqrt(np.maximum(LID_RADIUS**2 - loops[..., 0] ** 2, 1.0))
    smooth = np.minimum(drawn, 1.0) * np.array([0.0, 1.0, 1.0, 0.9, 0.5, 0.0])[:, None]
    new_radius = radius + smooth * np.minimum(shell - radius, 4.0).clip(-4.0)
    shut = np.clip(upper + lower, 0.0, 1.0)  # margins that meet need the same depth
    new_radius[0] += shut * 0.5 * (radius[0][(-np.arange(count)) % count] - radius[0])
    new_margin = np.arcsin(np.clip(height / new_radius[0], -1, 1))
    new_angle = angle + (angle - angle[_STILL]) / span * (new_margin - angle[0])
    motion = np.zeros_like(mesh.vertices)
    for k in range(_STILL):
        y, z = new_radius[k] * np.sin(new_angle[k]), new_radius[k] * np.cos(new_angle[k])
        new = np.stack([loops[k, :, 0], y, z], 1)
        motion[rings[k]] = new - loops[k]
    for tag in ("lid_edge", "lid_hidden"):
        ring = mesh.tag(tag, "left")
        motion[ring] = turned(mesh.vertices[ring] - center, new_margin - angle[0])
    return motion


def turned(offset: Array, angle: Array) -> Array:
    """Return the displacement (N,3) of offsets turned upwards about the x axis by angles (N,)."""
    c, s = np.cos(angle), np.sin(angle)
    y = c * offset[:, 1] + s * offset[:, 2]
    z = -s * offset[:, 1] + c * offset[:, 2]
    return np.stack([offset[:, 0], y, z], 1) - offset
