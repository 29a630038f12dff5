"""Nostrils: loops on the underside of the nose and the hollow behind the rim."""

from __future__ import annotations

import numpy as np

from express50.head.generator.field import cast_out
from express50.head.generator.mesh import HalfMesh
from express50.head.generator.rays import labels

Array = np.ndarray

_INSIDE = np.array([7.0, -16.0, 105.0])  # a point above the nostril from which loops are cast
_DOWN = np.array([0.05, -0.97, 0.2])
_LONG = np.array([-0.24, 0.2, 0.95])  # from the ala's base towards the tip
_POINTS = 14


def add_nostril(half: HalfMesh) -> tuple[Array, Array]:
    """Add the left nostril. Returns (outer loop indices, their labels (N,2))."""
    down = _DOWN / np.linalg.norm(_DOWN)
    side = np.cross(_LONG, down)
    side /= np.linalg.norm(side)
    long = np.cross(down, side)
    turn = 2 * np.pi * np.arange(_POINTS) / _POINTS
    rings = []
    for a, b in ((0.66, 0.5), (0.52, 0.36), (0.42, 0.27)):  # half widths a mm of distance
        d = down + np.outer(np.cos(turn) * a, long) + np.outer(np.sin(turn) * b, side)
        rings.append(cast_out(np.tile(_INSIDE, (_POINTS, 1)), d))
    middle = rings[-1].mean(0)
    for shrink, lift in ((0.88, 1.6), (0.7, 4.5), (0.45, 7.5)):
        rings.append(middle + shrink * (rings[2] - middle) - lift * down)
    label = np.stack(labels(rings[0]), 1)
    center = label.mean(0)
    rows = []
    for k, (ring, f) in enumerate(zip(rings, (1, 0.85, 0.7, 0.55, 0.4, 0.2), strict=True)):
        rows.append(half.add(ring, f"nostril{k}"))
        half.label(rows[-1], center + f * (label - center))
        if k:
            half.strip("skin", rows[-1], rows[-2], closed=True)
    top = half.add((middle - 9.0 * down)[None], "nostril_top")
    half.label(top, center[None])
    half.fan("skin", int(top[0]), rows[-1], closed=True)
    return rows[0], label
