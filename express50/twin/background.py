"""The studio behind the subject: a round room with panels, lamps, poles and cables.

It belongs to the world, so every camera sees another part of it and neighbours agree.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from express50.geometry.cameras import Camera
from express50.geometry.conventions import cell_centres, corner_to_cell
from express50.twin.noise import fractal, make_lattice, noise, random_stream, smoothstep
from express50.twin.rig import TARGET
from express50.twin.surface import spherical_to_unit, unit, unit_to_spherical

RADIUS_M = 2.6
_HIGHEST = 0.95  # elevation up to which the wall is painted, radians; cameras see less


def room_width(camera: Camera) -> int:
    """Texels around the room that suit a camera; out of focus; 2048 or 4096."""
    wanted = 2 * np.pi * camera.K[0, 0] * 0.35
    return int(np.clip(2 ** np.round(np.log2(wanted)), 2048, 4096))


def background(
    seed: int, origin: np.ndarray, directions: np.ndarray, width: int = 2048
) -> np.ndarray:
    """Linear colours (N, 3) of rays that miss the subject.

    Args:
        seed: the studio's seed.
        origin: (3,) the camera's centre, inside the room.
        directions: (N, 3), any length.
        width: texels around the room.
    """
    d = unit(directions)
    start = np.asarray(origin - TARGET, d.dtype)
    b = d @ start
    reach = -b + np.sqrt(np.maximum(b * b - start @ start + RADIUS_M**2, 0.0))
    az, el = unit_to_spherical(start + reach[:, None] * d)
    room = _room(seed, width)
    height = room.shape[0]
    x = corner_to_cell((az / (2 * np.pi) + 0.5) * width)
    y = np.clip(corner_to_cell((el / (2 * _HIGHEST) + 0.5) * height), 0, height - 1.01)
    left, top = np.floor(x), np.floor(y)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    x0, y0 = left.astype(np.int32), top.astype(np.int32)
    xa, xb = x0 % width, (x0 + 1) % width
    low = room[y0, xa] * (1 - fx) + room[y0, xb] * fx
    high = room[y0 + 1, xa] * (1 - fx) + room[y0 + 1, xb] * fx
    return (low * (1 - fy) + high * fy).astype(np.float32)


@cache
def _room(seed: int, width: int) -> np.ndarray:
    """The room's wall (H, W, 3) float32, by azimuth and elevation from its middle."""
    rng = random_stream(seed, 201)
    height = 2 * round(width * _HIGHEST / (2 * np.pi))
    az = (cell_centres(width) / width * 2 * np.pi - np.pi).astype(np.float32)
    el = ((cell_centres(height) / height * 2 - 1) * _HIGHEST).astype(np.float32)
    base = np.array([0.17, 0.185, 0.20]) * rng.uniform(0.85, 1.2) * rng.uniform(0.93, 1.07, 3)
    shade = (1 + 0.35 * np.clip(el, -0.8, 0.8))[:, None] * _panels(az, el, make_lattice(rng))
    shade *= _felt(rng, az, el)
    wall = shade[..., None] * base.astype(np.float32)
    for _ in range(14):
        _pole(rng, wall, az, el)
    for _ in range(4):
        _cable(rng, wall, az, el)
    for _ in range(10):
        _lamp(rng, wall, az, el)
    # The wall is far behind the plane of focus.
    return cv2.GaussianBlur(wall, None, 0.0016 * width / (2 * np.pi) + 0.7)


def _felt(rng: np.random.Generator, az: np.ndarray, el: np.ndarray) -> np.ndarray:
    """Blotches (H, W) of the wall; made at half size, they are smooth."""
    points = spherical_to_unit(*np.meshgrid(az[::2], el[::2])).reshape(-1, 3) * RADIUS_M
    grain = 1 + 0.16 * fractal(points, make_lattice(rng), 0.55, 4, 0.55)
    return cv2.resize(grain.reshape(len(el) // 2, len(az) // 2), (len(az), len(el)))


def _panels(az: np.ndarray, el: np.ndarray, lattice: np.ndarray) -> np.ndarray:
    """Brightness (H, W) of felt panels with dark seams; each panel is a little different."""
    columns, rows = az / (2 * np.pi) * 22, (el + 0.5 * np.pi) / np.pi * 9
    seam_x = smoothstep(np.abs(columns - np.round(columns)) / 22, 0.0004, 0.0016)
    seam_y = smoothstep(np.abs(rows - np.round(rows)) / 18, 0.0004, 0.0016)
    x, y = np.meshgrid(np.floor(columns) * 3.7, np.floor(rows) * 5.3)
    own = noise(np.stack([x, y, 0 * x], -1).reshape(-1, 3), lattice).reshape(x.shape)
    return (0.55 + 0.45 * seam_x * seam_y[:, None]) * (1 + 0.22 * own)


def _around(az: np.ndarray, centre: float | np.ndarray) -> np.ndarray:
    """Angle from a centre, wrapped to [-pi, pi)."""
    return (az - centre + np.pi) % (2 * np.pi) - np.pi


def _pole(rng: np.random.Generator, wall: np.ndarray, az: np.ndarray, el: np.ndarray) -> None:
    """A steel stand with rounded shading; edits ``wall``."""
    centre, half = rng.uniform(-np.pi, np.pi), rng.uniform(0.006, 0.016)
    lean, metal, tint = rng.uniform(-0.08, 0.08), rng.uniform(0.05, 0.4), rng.uniform(0.9, 1.1, 3)
    near = np.flatnonzero(np.abs(_around(az, centre)) < 0.14 + 2 * half)
    across = _around(az[near], centre + lean * el[:, None]) / half
    inside = smoothstep(np.abs(across), 1.08, 0.92)[..., None]
    round_shade = metal * (0.25 + 0.75 * np.sqrt(np.clip(1 - across**2, 0, 1)))
    wall[:, near] += inside * (round_shade[..., None] * tint - wall[:, near])


def _cable(rng: np.random.Generator, wall: np.ndarray, az: np.ndarray, el: np.ndarray) -> None:
    """A sagging cable; edits ``wall``."""
    base, waves = rng.uniform(-0.6, 0.7), rng.integers(2, 6)
    line = base + 0.12 * np.abs(np.sin(0.5 * waves * az + rng.uniform(0, 6)))
    rows = np.flatnonzero((el > base - 0.01) & (el < base + 0.13))
    inside = smoothstep(np.abs(el[rows, None] - line), 0.006, 0.003)[..., None]
    wall[rows] += inside * (np.array([0.03, 0.03, 0.033]) - wall[rows])


def _lamp(rng: np.random.Generator, wall: np.ndarray, az: np.ndarray, el: np.ndarray) -> None:
    """A bright or dark box: a light, a camera housing; edits ``wall``."""
    centre, level = rng.uniform(-np.pi, np.pi), rng.uniform(-0.5, 0.6)
    w, h = rng.uniform(0.03, 0.09, 2)
    bright = rng.uniform(0.45, 0.75) if rng.uniform() < 0.4 else rng.uniform(0.03, 0.12)
    colour = bright * rng.uniform(0.92, 1.08, 3)
    columns = np.flatnonzero(np.abs(_around(az, centre)) < 1.1 * w)
    rows = np.flatnonzero(np.abs(el - level) < 1.1 * h)
    u, v = np.abs(_around(az[columns], centre)) / w, np.abs(el[rows] - level) / h
    inside = smoothstep(np.maximum(u, v[:, None]), 1.03, 0.97)[..., None]
    patch = np.ix_(rows, columns)
    wall[patch] += inside * (colour - wall[patch])
