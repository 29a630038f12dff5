"""Depth straight from the signed distances: sphere tracing, then a bracketed root.

No mesh comes between grid and picture, so nothing is lost to triangles; casting rays at the mesh is
several times faster (docs/LOG.md).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from express50.geometry.cameras import Camera, rays
from pipelines.depth.blocks import Grid
from pipelines.depth.finish import Surface
from pipelines.depth.raycast import DepthView, depth_view
from pipelines.depth.surface import grid_normals

RELAXATION = 0.8  # distances were moved and smoothed: they are not exact
LEAST_STEP, MOST_STEPS, ROOT_STEPS = 0.25, 400, 12  # the first in voxels


def trace_view(surface: Surface, camera: Camera, alpha: np.ndarray) -> DepthView:
    """What a camera sees of the surface's signed distances; valid inside the matte (H, W)."""
    depth = trace(surface.grid, camera)
    hit = np.isfinite(depth)
    origin, directions = rays(camera)
    points = origin + depth[hit, None] * directions[hit]
    normals = np.zeros((*depth.shape, 3))
    normals[hit] = grid_normals(surface.grid, (points - surface.grid.origin) / surface.grid.voxel)
    used = np.unique(surface.faces)
    confidence = np.zeros(depth.shape)
    if hit.any():
        nearest = cKDTree(surface.vertices[used]).query(points)[1]
        confidence[hit] = surface.confidence[used][nearest]
    return depth_view(camera, alpha, depth, normals, confidence)


def trace(grid: Grid, camera: Camera) -> np.ndarray:
    """Depth (H, W), camera z in metres, of the first zero along every ray; infinite without one.

    Steps are a share of the distance (Hart 1996) until the sign changes; the zero between the last
    two places is found by the Illinois variant of false position, which keeps it bracketed.
    """
    origin, directions = rays(camera)
    flat = directions.reshape(-1, 3)
    near, far = _box_span(grid, origin, flat)
    depth = np.full(len(flat), np.inf)
    alive = np.flatnonzero(near < far)
    t, length = near[alive], np.linalg.norm(flat[alive], axis=1)
    before = t.copy()
    for _ in range(MOST_STEPS):
        value = grid.sample(origin + t[:, None] * flat[alive])
        inside = value < 0
        found = alive[inside]
        depth[found] = _root(grid, origin, flat[found], before[inside], t[inside])
        step = np.maximum(RELAXATION * value, LEAST_STEP * grid.voxel) / length
        onward = ~inside & (t + step < far[alive])
        if not onward.any():
            break
        before, t = t[onward], (t + step)[onward]
        alive, length = alive[onward], length[onward]
    return depth.reshape(directions.shape[:2]).astype(np.float32)


def _box_span(
    grid: Grid, origin: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where rays (N, 3) enter and leave the grid (N,), (N,); near is not under far if they miss."""
    high = grid.origin + grid.voxel * (np.array(grid.shape) - 1)
    steep = np.where(np.abs(directions) > 1e-12, directions, 1e-12)
    ends = np.stack([(grid.origin - origin) / steep, (high - origin) / steep])
    return np.maximum(ends.min(0).max(1), 1e-6), ends.max(0).min(1)


def _root(
    grid: Grid, origin: np.ndarray, directions: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Depths (N,) of the zeros between depths outside (N,) and inside (N,)."""

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
