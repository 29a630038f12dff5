"""Smooth random fields over space: value noise on a periodic lattice, and sums of its octaves."""

from __future__ import annotations

import numpy as np

LATTICE = 32


def make_lattice(rng: np.random.Generator) -> np.ndarray:
    """Return random values (32, 32, 32) in [-1, 1], float32, that :func:`noise` interpolates."""
    return rng.uniform(-1.0, 1.0, (LATTICE,) * 3).astype(np.float32)


def noise(points: np.ndarray, lattice: np.ndarray) -> np.ndarray:
    """Value noise (N,), about -1 to 1, at points (N, 3) in lattice cells; smooth, periodic."""
    p = np.asarray(points, dtype=np.float32)
    cell = np.floor(p)
    f = p - cell
    f = f * f * (3.0 - 2.0 * f)
    i0 = cell.astype(np.int32) & (LATTICE - 1)
    i1 = (i0 + 1) & (LATTICE - 1)
    flat = lattice.ravel()
    x0, x1 = i0[:, 0] * LATTICE * LATTICE, i1[:, 0] * LATTICE * LATTICE
    y0, y1 = i0[:, 1] * LATTICE, i1[:, 1] * LATTICE
    z0, z1 = i0[:, 2], i1[:, 2]
    fx, fy, fz = f.T
    near = _mix(_mix(flat[x0 + y0 + z0], flat[x1 + y0 + z0], fx),
                _mix(flat[x0 + y1 + z0], flat[x1 + y1 + z0], fx), fy)  # fmt: skip
    far = _mix(_mix(flat[x0 + y0 + z1], flat[x1 + y0 + z1], fx),
               _mix(flat[x0 + y1 + z1], flat[x1 + y1 + z1], fx), fy)  # fmt: skip
    return _mix(near, far, fz)


def _mix(a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    return a + (b - a) * t


def fractal(
    points: np.ndarray, lattice: np.ndarray, wavelength: float, octaves: int, gain: float = 0.5
) -> np.ndarray:
    """Sum (N,) of octaves of :func:`noise` at points (N, 3); ``wavelength`` in their unit."""
    total = np.zeros(len(points), dtype=np.float32)
    for octave in range(octaves):
        # The shift keeps lattice points of the octaves, where each is extremal, apart.
        scaled = np.asarray(points) * (2.0**octave / wavelength) + 7.31 * octave
        total += gain**octave * noise(scaled, lattice)
    return total


def random_stream(seed: int, *path: int) -> np.random.Generator:
    """Independent generator for a seed and a path of integers such as (subject, camera, frame)."""
    return np.random.default_rng([seed, *path])
