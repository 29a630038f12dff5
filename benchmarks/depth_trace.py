"""Trace depth in the signed distances, as a second opinion on rays cast at the mesh.

Sphere tracing, then a bracketed root: no mesh comes between the grid and the depth. The stage casts
rays at the mesh, which is seven times faster and differs by 0.005 mm.
"""

from __future__ import annotations

import numpy as np

from express50.geometry.cameras import Camera, rays
from pipelines.depth.blocks import LevelSet

RELAXATION = 0.8  # distances were moved and smoothed: they are not exact
LEAST_STEP = 0.25  # voxels; rays along the surface still advance
MOST_STEPS, ROOT_STEPS = 400, 12


def trace(grid: LevelSet, camera: Camera) -> np.ndarray:
    """Find the first zero along every ray: depth (H, W), camera z in metres, infinite without one.

    Steps are a share of the distance (Hart 1996) until the sign changes; the zero between the last
    two places is found by the Illinois variant of false position, which keeps it bracketed.
    """
    origin, directions = rays(camera)
    flat = directions.reshape(-1, 3)
    high = grid.origin + grid.voxel * (np.array(grid.shape) - 1)
    steep = np.where(np.abs(flat) > 1e-12, flat, 1e-12)
    ends = np.stack([(grid.origin - origin) / steep, (high - origin) / steep])
    near, far = np.maximum(ends.min(0).max(1), 1e-6), ends.max(0).min(1)  # in and out of the box
    depth = np.full(len(flat), np.inf)
    alive = np.flatnonzero(near < far)
    t, length = near[alive], np.linalg.norm(flat[alive], axis=1)
    before = t.copy()
    for _ in range(MOST_STEPS):
        value = grid.sample(origin + t[:, None] * flat[alive])
        inside = value < 0
        found = alive[inside]
        depth[found] = bracketed_root(grid, origin, flat[found], before[inside], t[inside])
        step = np.maximum(RELAXATION * value, LEAST_STEP * grid.voxel) / length
        onward = ~inside & (t + step < far[alive])
        if not onward.any():
            break
        before, t = t[onward], (t + step)[onward]
        alive, length = alive[onward], length[onward]
    return depth.reshape(directions.shape[:2]).astype(np.float32)


def bracketed_root(
    grid: LevelSet, origin: np.ndarray, directions: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Return depths (N,) of the zeros between depths outside (N,) and inside (N,)."""

    def value(t: np.ndarray) -> np.ndarray:
        return grid.sample(origin + t[:, None] * directions)

    above, below = value(low), value(high)
    t = high
    for _ in range(ROOT_STEPS):
        t = low + (high - low) * above / np.maximum(above - below, 1e-12)
        now = value(t)
        outside = now > 0
        # an end that stays twice would be approached from one side only: its weight is halved
        below, above = np.where(outside, below / 2, now), np.where(outside, now, above / 2)
        low, high = np.where(outside, t, low), np.where(outside, high, t)
    return t
