"""From views to one surface: visual hull, tracked mesh, photo-consistency, coarse to fine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from express50.errors import StageError
from pipelines.depth.blocks import (
    BLOCK,
    VOXEL_LIMIT,
    Grid,
    assemble,
    at,
    build,
    combined,
    held,
    voxel_index,
)
from pipelines.depth.config import DepthConfig
from pipelines.depth.filters import refined
from pipelines.depth.finish import Surface, finished, patch_scores, pixel_size
from pipelines.depth.grid import (
    UNSEEN,
    View,
    head_box,
    hull_distance,
)
from pipelines.depth.prior import Prior
from pipelines.depth.surface import (
    advance,
    extract_mesh,
    fair,
    graph_laplacian,
    rim_targets,
    smooth_displacement,
)

LEVEL_RATIO = 1.47
COUPLINGS = (1e3, 3e3, 1e4, 2e4)  # per square metre; a gap of 10 mm costs 0.1 at first, 2 at last
SMALLEST_M, LARGEST_M = 0.03, 3.0  # a head is 0.25 m high, with shoulders under 1 m


def reconstruct(
    views: Sequence[View],
    config: DepthConfig,
    prior: Prior | None = None,
) -> Surface:
    """Reconstruct the surface that the views share.

    Args:
        views: usable views, at least two.
        config: the knobs.
        prior: the tracked mesh, or None.

    Raises:
        StageError: the mattes share no volume, or the box or surface is too large for the voxel.
    """
    low, high = head_box(views)
    extent = float(np.linalg.norm(high - low))
    voxels = _voxels(views, (low + high) / 2, config)
    _check_size(low, high, voxels[-1])
    grid = _initial(views, low, high, voxels[0], prior)
    for level, voxel in enumerate(voxels):
        if grid.voxel != voxel:
            grid = refined(grid, voxel)
        hull = _hull(views, grid)
        grid = combined(np.maximum, grid, hull)
        if prior is None or level:
            grid = fair(grid, config.fair_voxels * voxel)
        deep = level == 0 and prior is None
        grid = _move(views, grid, hull, config, extent, first=deep)
    return finished(views, grid, config)


def tracked_surface(view: View, config: DepthConfig, prior: Prior) -> Surface:
    """The tracked head as it is: a single view tells nothing else of depth.

    Raises:
        StageError: the head is too small or too large for the voxel.
    """
    (voxel,) = _voxels([view], (prior.low + prior.high) / 2, config)[-1:]
    low, high = prior.low - 4 * voxel, prior.high + 4 * voxel
    _check_size(low, high, voxel)
    return finished([view], build(low, high, voxel, prior.distance), config)


def _voxels(views: Sequence[View], middle: np.ndarray, config: DepthConfig) -> list[float]:
    """Voxels of the levels, metres, coarse to fine; the last as fine as the pixels allow."""
    pixel = float(np.median([pixel_size(view, middle) for view in views]))
    fine = max(config.voxel_mm * 1e-3, config.voxel_px * pixel)
    coarser = np.log(config.coarse_mm * 1e-3 / fine) / np.log(LEVEL_RATIO)
    return [fine * LEVEL_RATIO**k for k in reversed(range(1 + max(0, round(coarser))))]


def _check_size(low: np.ndarray, high: np.ndarray, voxel: float) -> None:
    extent = float((high - low).max())
    if extent < SMALLEST_M:
        raise StageError(
            f"the head's box is {extent * 1e3:.3g} mm large; expected {SMALLEST_M * 1e3:g} mm and"
            " more: is the calibration in metres?"
        )
    blocks = float(np.prod((high - low) / (BLOCK * voxel)))
    if blocks > VOXEL_LIMIT or extent > LARGEST_M:
        size = " x ".join(f"{side:.2f}" for side in high - low)
        raise StageError(
            f"the head's box is {size} m, {blocks:.2g} blocks of voxels of {voxel * 1e3:g} mm;"
            f" expected at most {LARGEST_M:g} m and {VOXEL_LIMIT:.2g}: is the calibration in"
            " metres? else raise depth.voxel_mm"
        )


def _initial(
    views: Sequence[View], low: np.ndarray, high: np.ndarray, voxel: float, prior: Prior | None
) -> Grid:
    """Distances to the visual hull, and to the tracked mesh where that is known."""
    if prior is None:
        return hull_grid(views, low, high, voxel)

    def distance(points: np.ndarray) -> np.ndarray:
        return prior.merge(points, hull_distance(views, points), 2 * voxel)

    return build(low, high, voxel, distance)


def hull_grid(views: Sequence[View], low: np.ndarray, high: np.ndarray, voxel: float) -> Grid:
    """Signed distances to the visual hull in a box with these corners (3,), metres."""
    return build(low, high, voxel, lambda points: hull_distance(views, points))


def _hull(views: Sequence[View], grid: Grid) -> Grid:
    """Distances to the visual hull near the grid's surface, inside elsewhere."""

    def values(places: np.ndarray) -> np.ndarray:
        near = np.abs(at(grid, places)) < 4 * grid.voxel
        hull = np.full(near.shape, -UNSEEN, np.float32)
        hull[near] = hull_distance(views, grid.points(voxel_index(places)[near]))
        return hull

    inside = np.ones(grid.table.shape, bool)
    return assemble(grid.origin, grid.voxel, grid.shape, inside, held(grid), values)


def _move(
    views: Sequence[View],
    grid: Grid,
    hull: Grid,
    config: DepthConfig,
    extent: float,
    first: bool,
) -> Grid:
    """One level: slide patches, solve for a smooth displacement, move the surface."""
    voxel = grid.voxel
    vertices, normals, faces = extract_mesh(grid)
    if not len(faces):
        return grid
    offsets = _offsets(config, voxel, first)
    if config.photo:
        scores = patch_scores(views, grid, vertices, normals, faces, offsets, config)
    else:
        scores = np.zeros((len(vertices), len(offsets)), np.float32)
    pinned, weight = _pins(views, grid, vertices, extent, config.rim_weight)
    displacement, _ = smooth_displacement(
        scores,
        offsets,
        graph_laplacian(faces, len(vertices)),
        pinned,
        weight,
        config.stiffness_voxels**4,
        COUPLINGS,
    )
    return combined(np.maximum, advance(grid, vertices, displacement), hull)


def _offsets(config: DepthConfig, voxel: float, first: bool) -> np.ndarray:
    """Offsets (D,) along the normal, metres: from deep below a hull, else a few voxels around."""
    if first:
        return np.arange(-config.inward_mm * 1e-3, 1.01 * voxel, voxel / 2)
    return np.arange(-2.0, 2.01, 0.4) * voxel


def _pins(
    views: Sequence[View], grid: Grid, vertices: np.ndarray, extent: float, rim_weight: float
) -> tuple[np.ndarray, np.ndarray]:
    """Displacements (V,) and weights (V,) that bring the surface out to every silhouette."""
    points = rim_targets(views, grid, extent)
    pinned, count = np.zeros(len(vertices)), np.zeros(len(vertices))
    if len(points):
        lack = grid.sample(points)
        close = np.abs(lack) < 4 * grid.voxel
        near = cKDTree(vertices).query(points[close])[1]
        np.add.at(pinned, near, lack[close])
        np.add.at(count, near, 1.0)
    return pinned / np.maximum(count, 1), rim_weight * np.minimum(count, 1)
