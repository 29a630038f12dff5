"""Lid motions: exact turns about the eyeball's centre, so that lids slide over the eye."""

from __future__ import annotations

import numpy as np

from express50.head.procedural_eyes import LID_SEGMENTS
from express50.head.procedural_influence import eye_center
from express50.head.procedural_mesh import WholeMesh

Array = np.ndarray

_FALLOFF = (1.0, 0.9, 0.76, 0.58, 0.36, 0.16, 0.04, 0.0)
_MEETING = 0.14  # share of the opening that the lower lid closes in a blink


def _upper(count: int = 2 * LID_SEGMENTS) -> Array:
    return np.arange(count) < LID_SEGMENTS + 0.5


def lid_motion(mesh: WholeMesh, side: str, upper: float, lower: float) -> Array:
    """Displacement (V,3) mm moving the lids' margins by shares of the opening.

    Args:
        mesh: The head.
        side: "left" or "right".
        upper: Share of the opening by which the upper margin comes down (negative: up).
        lower: Share by which the lower margin comes up (negative: down).
    """
    center = eye_center(side)
    margin = mesh.vertices[mesh.tag("lid0", side)] - center
    opposite = margin[(-np.arange(len(margin))) % len(margin)]
    share = np.where(_upper(), upper, lower)
    height = margin[:, 1] + share * (opposite[:, 1] - margin[:, 1])
    radius = np.hypot(margin[:, 1], margin[:, 2])
    angle = np.arcsin(np.clip(height / radius, -1, 1)) - np.arcsin(margin[:, 1] / radius)
    motion = np.zeros_like(mesh.vertices)
    rows = [(f"lid{k}", f) for k, f in enumerate(_FALLOFF)]
    for tag, f in [*rows, ("lid_edge", 1.0), ("lid_hidden", 1.0)]:
        ring = mesh.tag(tag, side)
        motion[ring] = turned(mesh.vertices[ring] - center, f * angle)
    return motion


def turned(offset: Array, angle: Array) -> Array:
    """Displacement (N,3) of offsets turned upwards about the x axis by angles (N,)."""
    c, s = np.cos(angle), np.sin(angle)
    y = c * offset[:, 1] + s * offset[:, 2]
    z = -s * offset[:, 1] + c * offset[:, 2]
    return np.stack([offset[:, 0], y, z], 1) - offset


def blink(mesh: WholeMesh, side: str) -> Array:
    """Displacement (V,3) mm that shuts the lids."""
    return lid_motion(mesh, side, 1.0 - _MEETING, _MEETING)
