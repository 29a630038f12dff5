"""Eyelid loops of the skin, the lids' hidden edges, and the eyeballs."""

from __future__ import annotations

import numpy as np

from express50.head.generator.field import EYE_CENTER, EYE_RADIUS, cast
from express50.head.generator.mesh import HalfMesh
from express50.head.generator.rays import labels

Array = np.ndarray

LID_SEGMENTS = 20
INNER_CANTHUS = np.array([17.4, 18.2])
OUTER_CANTHUS = np.array([45.8, 20.6])
_ORBIT_CENTER, _ORBIT_RADII = np.array([32.0, 20.5]), np.array([21.5, 17.5])
_FRACTIONS = (0.0, 0.09, 0.2, 0.33, 0.48, 0.65, 0.82, 1.0)
IRIS_RADIUS, PUPIL_RADIUS = 5.9, 1.9


def lid_margin() -> Array:
    """Front view (x, y) of the lid margin (40,2) mm: upper lid outwards, lower lid back."""
    s = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, LID_SEGMENTS + 1))
    line = INNER_CANTHUS + s[:, None] * (OUTER_CANTHUS - INNER_CANTHUS)
    upper, lower = line.copy(), line.copy()
    upper[:, 1] += 5.1 * np.abs(np.sin(np.pi * s**0.88)) ** 0.8
    lower[:, 1] -= 5.0 * np.abs(np.sin(np.pi * s**1.12)) ** 0.85
    return np.concatenate([upper, lower[-2:0:-1]])


def from_front(xy: Array) -> Array:
    """Skin points (N,3) straight behind front-view positions (N,2)."""
    origins = np.concatenate([xy, np.zeros((len(xy), 1))], 1)
    return cast(origins, np.tile([0.0, 0.0, 1.0], (len(xy), 1)))


def add_eye_rings(half: HalfMesh) -> tuple[Array, Array]:
    """Lid loops out to the orbit's rim. Returns (outer ring indices, their labels (N,2))."""
    margin = lid_margin()
    angle = np.pi - np.pi * np.arange(2 * LID_SEGMENTS) / LID_SEGMENTS
    outer = _ORBIT_CENTER + _ORBIT_RADII * np.stack([np.cos(angle), np.sin(angle)], 1)
    rings = [from_front(margin + f * (outer - margin)) for f in _FRACTIONS]
    outer_label = np.stack(labels(rings[-1]), 1)
    margin_label = np.stack(labels(rings[0]), 1)
    indices = [half.add(ring, f"lid{k}") for k, ring in enumerate(rings)]
    for index, f in zip(indices, _FRACTIONS, strict=True):
        half.label(index, margin_label + f * (outer_label - margin_label))
    for inner, out in zip(indices[:-1], indices[1:], strict=True):
        half.strip("skin", inner, out, closed=True)
    _add_lid_edges(half, indices[0], rings[0], margin_label)
    return indices[-1], outer_label


def _add_lid_edges(half: HalfMesh, margin: Array, points: Array, label: Array) -> None:
    """The lid's thickness: an edge down to the eyeball, then a strip hidden under the lid."""
    away = points - EYE_CENTER
    edge = EYE_CENTER + away * (EYE_RADIUS + 0.15) / np.linalg.norm(away, axis=1, keepdims=True)
    xy = points[:, :2] - points[:, :2].mean(0)
    xy = xy / np.linalg.norm(xy, axis=1, keepdims=True)
    hidden = edge + np.pad(xy * 4.0, ((0, 0), (0, 1))) - EYE_CENTER
    hidden = EYE_CENTER + hidden * (EYE_RADIUS + 0.2) / np.linalg.norm(hidden, axis=1)[:, None]
    middle = label.mean(0)
    rows = [margin]
    for tag, ring, f in (("lid_edge", edge, 0.86), ("lid_hidden", hidden, 0.6)):
        rows.append(half.add(ring, tag))
        half.label(rows[-1], middle + f * (label - middle))
        half.strip("skin", rows[-2], rows[-1], closed=True)


def add_eyeball(half: HalfMesh, columns: int = 28) -> None:
    """A sphere with its pole forward: rings at the pupil's and iris's rims, two UV charts."""
    iris = np.degrees(np.arcsin(IRIS_RADIUS / EYE_RADIUS))
    pupil = np.degrees(np.arcsin(PUPIL_RADIUS / EYE_RADIUS))
    polar = np.radians(
        [
            pupil,
            pupil + 2,
            0.5 * (pupil + iris),
            iris,
            iris + 2,
            42,
            54,
            66,
            78,
            90,
            110,
            130,
            150,
            167,
        ]
    )
    turn = 2 * np.pi * np.arange(columns) / columns
    circle = np.stack([np.cos(turn), np.sin(turn)], 1)
    front = int(half.add(EYE_CENTER + [[0, 0, EYE_RADIUS]], "eyeball")[0])
    rings = []
    for k, a in enumerate(polar):
        ring = np.concatenate([np.sin(a) * circle, np.full((columns, 1), np.cos(a))], 1)
        rings.append(half.add(EYE_CENTER + EYE_RADIUS * ring, "eyeball"))
        if k <= 9:
            half.set_uv("eye_front", rings[-1], circle * a / np.pi)
        if k >= 9:
            half.set_uv("eye_back", rings[-1], circle * [-1, 1] * (np.pi - a) / np.pi)
    back = int(half.add(EYE_CENTER - [[0, 0, EYE_RADIUS]], "eyeball")[0])
    pole = np.zeros((1, 2))
    half.set_uv("eye_front", np.array([front]), pole)
    half.set_uv("eye_back", np.array([back]), pole)
    half.fan("eye_front", front, rings[0], closed=True)
    half.fan("eye_back", back, rings[-1], closed=True)
    for k in range(len(rings) - 1):
        half.strip("eye_front" if k < 9 else "eye_back", rings[k], rings[k + 1], closed=True)
    half.tags["pupil"] = np.concatenate([[front], rings[0]])
    half.tags["iris"] = np.concatenate([[front], *rings[:4]])
