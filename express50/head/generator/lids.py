"""Lid motions: exact turns about the eyeball's centre, so that lids slide over the eye."""

from __future__ import annotations

import numpy as np

from express50.head.generator.eyes import LID_SEGMENTS
from express50.head.generator.field import LID_RADIUS
from express50.head.generator.influence import eye_center
from express50.head.generator.mesh import WholeMesh

Array = np.ndarray

_STILL = 5  # lid loop that does not move; loops inside it share the margin's motion
_MEETING = 0.14  # share of the opening that the lower lid closes in a blink


def lid_motion(mesh: WholeMesh, side: str, upper: float, lower: float) -> Array:
    """Displacement (V,3) mm moving the lids' margins by shares of the opening.

    Loops between the margin and the still loop are spread evenly over the lengthened lid, turning
    about the eyeball's centre, and the upper lid's fold is pulled smooth onto the lid's sphere.

    Args:
        mesh: The head.
        side: "left" or "right".
        upper: Share of the opening by which the upper margin comes down (negative: up).
        lower: Share by which the lower margin comes up (negative: down).
    """
    center = eye_center(side)
    loops = np.stack([mesh.vertices[mesh.tag(f"lid{k}", side)] for k in range(_STILL + 1)]) - center
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
    shut = np.clip(upper + lower, 0.0, 1.0)  # margins that meet must agree in depth
    new_radius[0] += shut * 0.5 * (radius[0][(-np.arange(count)) % count] - radius[0])
    new_margin = np.arcsin(np.clip(height / new_radius[0], -1, 1))
    new_angle = angle + (angle - angle[_STILL]) / span * (new_margin - angle[0])
    motion = np.zeros_like(mesh.vertices)
    for k in range(_STILL):
        new = np.stack(
            [
                loops[k, :, 0],
                new_radius[k] * np.sin(new_angle[k]),
                new_radius[k] * np.cos(new_angle[k]),
            ],
            1,
        )
        motion[mesh.tag(f"lid{k}", side)] = new - loops[k]
    for tag in ("lid_edge", "lid_hidden"):
        ring = mesh.tag(tag, side)
        motion[ring] = turned(mesh.vertices[ring] - center, new_margin - angle[0])
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
