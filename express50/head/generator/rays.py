"""Foliation of the space around the head: rays (azimuth, latitude) from a bent central axis.

Latitude is a label, not an angle: 90 at the crown, 0 at the eye line, -45 at the chin's edge,
-80 at the collar. The table gives for each latitude the ray's origin on the axis and elevation,
chosen so that rays meet the skin (even under the nose and the jaw) and never cross outside it.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import PchipInterpolator

Array = np.ndarray

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
    """Azimuth (radians) and latitude (deg) of points (N,3) in mm: the inverse of `rays`."""
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
    """Unit vectors (N,3) of the labels, the domain in which the skin is triangulated."""
    b = np.radians(latitude)
    return np.stack([np.cos(b) * np.sin(azimuth), np.sin(b), np.cos(b) * np.cos(azimuth)], -1)
