"""Reconstruct a surface from views: visual hull, tracked mesh, photo-consistency."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from express50.errors import StageError
from express50.geometry.sampling import bilinear
from pipelines.depth.blocks import (
    BLOCK,
    VOXEL_LIMIT,
    LevelSet,
    assemble,
    at,
    build,
    combined,
    held,
    largest_body,
    refined,
    voxel_index,
)
from pipelines.depth.hull import UNSEEN, head_box, hull_distance
from pipelines.depth.prior import TrackedSolid
from pipelines.depth.surface import (
    HeadMesh,
    advance,
    averaged,
    extract_mesh,
    fair,
    graph_laplacian,
    largest_part,
    rim_targets,
    smooth_displacement,
)
from pipelines.depth.sweep import patch_scores, view_weights
from pipelines.depth.views import DepthView, pixel_size, project_fast

COARSE_M = 0.006  # voxel of the first level: it spans the gap between hull and face
LEVEL_RATIO = 1.47  # each level is so many times finer than the one before
INWARD_M = 0.03  # how far below the hull the first level searches: eye sockets are that deep
FAIR_VOXELS = 1.4  # smoothing before each level; less gains 0.012 mm but fails with three views
SMALLEST_M, LARGEST_M = 0.03, 3.0  # a head is 0.25 m high, with shoulders under 1 m
HULL_CONFIDENCE = 0.3  # where only silhouettes speak
LEAST_CONFIDENCE = 0.1  # where nothing does; that of a tracked head in a single view


@dataclass(frozen=True)
class HeadSurface:
    """The reconstructed head.

    Attributes:
        vertices (V, 3), normals (V, 3): world, metres, outward.
        faces: (F, 3).
        confidence: (V,) in [0, 1]; agreement of the views, 0.3 where only silhouettes speak.
        colors: (V, 3) uint8 sRGB.
        grid: signed distances from which the mesh was taken.
        figures: voxels and agreement, for the metrics.
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    confidence: np.ndarray
    colors: np.ndarray
    grid: LevelSet
    figures: dict = field(default_factory=dict)


def reconstruct(
    views: Sequence[DepthView],
    solid: TrackedSolid | None = None,
    voxel_mm: float = 1.6,
    voxel_px: float = 1.4,
    noise: float = 0.8,
) -> HeadSurface:
    """Reconstruct the surface that the views share.

    Args:
        views: usable views, at least two.
        solid: the tracked mesh, or None.
        voxel_mm: voxel of the last level, millimetres.
        voxel_px: it spans at least this many pixels.
        noise: standard deviation, 8-bit steps, under which texture does not count.

    Raises:
        StageError: the mattes share no volume, or the box or surface is too large for the voxel.
    """
    low, high = head_box(views)
    extent = float(np.linalg.norm(high - low))
    fine = finest_voxel(views, (low + high) / 2, voxel_mm, voxel_px)
    _check_size(low, high, fine)
    coarser = np.log(COARSE_M / fine) / np.log(LEVEL_RATIO)
    voxels = [fine * LEVEL_RATIO**k for k in reversed(range(1 + max(0, round(coarser))))]

    def start(points: np.ndarray) -> np.ndarray:
        hull = hull_distance(views, points)
        return hull if solid is None else solid.merge(points, hull, 2 * voxels[0])

    grid = build(low, high, voxels[0], start)
    for level, voxel in enumerate(voxels):
        if grid.voxel != voxel:
            grid = refined(grid, voxel)
        hull = _hull_near(views, grid)
        grid = combined(np.maximum, grid, hull)
        if solid is None or level:
            grid = fair(grid, FAIR_VOXELS * voxel)
        if level == 0 and solid is None:  # the surface may lie deep below the hull
            offsets = np.arange(-INWARD_M, 1.01 * voxel, voxel / 2)
        else:
            offsets = np.arange(-2.0, 2.01, 0.4) * voxel
        grid = combined(np.maximum, _moved(views, grid, extent, offsets, noise), hull)
    return _finished(views, grid, noise)


def tracked_surface(
    view: DepthView, solid: TrackedSolid, voxel_mm: float, voxel_px: float, noise: float
) -> HeadSurface:
    """Take the tracked head as it is: a single view says nothing else about depth.

    Raises:
        StageError: the head is too small or too large for the voxel.
    """
    voxel = finest_voxel([view], (solid.low + solid.high) / 2, voxel_mm, voxel_px)
    low, high = solid.low - 4 * voxel, solid.high + 4 * voxel
    _check_size(low, high, voxel)
    return _finished([view], build(low, high, voxel, solid.distance), noise)


def finest_voxel(
    views: Sequence[DepthView], middle: np.ndarray, voxel_mm: float, voxel_px: float
) -> float:
    """Choose the voxel of the last level, metres, as fine as the pixels at a point (3,) allow."""
    pixel = float(np.median([pixel_size(view, middle) for view in views]))
    return max(voxel_mm * 1e-3, voxel_px * pixel)


def _check_size(low: np.ndarray, high: np.ndarray, voxel: float) -> None:
    """Refuse a box with corners (3,), (3,) unlike a head in metres, or too large to hold."""
    extent = float((high - low).max())
    if extent < SMALLEST_M:
        raise StageError(
            f"the head's box is {extent * 1e3:.3g} mm large, expected at least"
            f" {SMALLEST_M * 1e3:g} mm: is the calibration in metres?"
        )
    blocks = float(np.prod((high - low) / (BLOCK * voxel)))
    if blocks > VOXEL_LIMIT or extent > LARGEST_M:
        size = " x ".join(f"{side:.2f}" for side in high - low)
        raise StageError(
            f"the head's box is {size} m, {blocks:.2g} blocks of voxels of {voxel * 1e3:g} mm;"
            f" expected at most {LARGEST_M:g} m and {VOXEL_LIMIT:.2g}: is the calibration in"
            " metres? If it is, raise depth.voxel_mm"
        )


def _hull_near(views: Sequence[DepthView], grid: LevelSet) -> LevelSet:
    """Measure distances to the visual hull near the grid's surface; elsewhere they are inside."""

    def values(places: np.ndarray) -> np.ndarray:
        near = np.abs(at(grid, places)) < 4 * grid.voxel
        hull = np.full(near.shape, -UNSEEN, np.float32)
        hull[near] = hull_distance(views, grid.points(voxel_index(places)[near]))
        return hull

    inside = np.ones(grid.table.shape, bool)
    return assemble(grid.origin, grid.voxel, grid.shape, inside, held(grid), values)


def _moved(
    views: Sequence[DepthView], grid: LevelSet, extent: float, offsets: np.ndarray, noise: float
) -> LevelSet:
    """Move the surface once: slide patches by offsets (D,), metres, solve for a displacement.

    Silhouettes pull as hard as a perfect photographic match: the surface is brought out to them
    (``extent`` is the box's diagonal, metres).
    """
    mesh = extract_mesh(grid)
    if not len(mesh.faces):
        return grid
    scores = patch_scores(views, grid, mesh, offsets, noise)
    points = rim_targets(views, grid, extent)
    pinned, count = np.zeros(len(mesh.vertices)), np.zeros(len(mesh.vertices))
    if len(points):
        lack = grid.sample(points)
        close = np.abs(lack) < 4 * grid.voxel
        near = cKDTree(mesh.vertices).query(points[close])[1]
        np.add.at(pinned, near, lack[close])
        np.add.at(count, near, 1.0)
    laplacian = graph_laplacian(mesh.faces, len(mesh.vertices))
    pinned, weight = pinned / np.maximum(count, 1), np.minimum(count, 1)
    displacement, _ = smooth_displacement(scores, offsets, laplacian, pinned, weight)
    return advance(grid, mesh.vertices, displacement)


def _finished(views: Sequence[DepthView], grid: LevelSet, noise: float) -> HeadSurface:
    """Take mesh, confidence and colours from the final grid."""
    grid = largest_body(grid)
    mesh = extract_mesh(grid)
    if not len(mesh.faces):
        raise StageError(
            f"no surface is left on a grid of {grid.voxel * 1e3:.3g} mm voxels; expected a head"
            " larger than a few voxels: check the mattes, or lower depth.voxel_mm"
        )
    mesh = mesh._replace(faces=largest_part(mesh.vertices, mesh.faces))
    vertices, normals, faces = mesh
    agreement = patch_scores(views, grid, mesh, np.array([-1.0, 0.0, 1.0]) * grid.voxel, noise)
    agreement = agreement[:, 1]
    on_hull = np.abs(hull_distance(views, vertices)) < 0.5 * grid.voxel
    confidence = averaged(np.clip(agreement, 0, 1), faces, rounds=6)
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    figures = {
        "voxel_mm": grid.voxel * 1e3,
        "voxels_allocated": grid.allocated,
        "voxels_dense": math.prod(grid.shape),
        "voxel_limit": VOXEL_LIMIT,
        "grid_bytes": grid.nbytes,
        "vertices": int(used.sum()),
        "photo_agreement_median": float(np.median(agreement[used])),
        "photo_supported": float((confidence[used] > 0.3).mean()),
        "silhouette_supported": float(on_hull[used].mean()),
    }
    floor = np.where(on_hull, HULL_CONFIDENCE, LEAST_CONFIDENCE)
    confidence = np.maximum(confidence, floor).astype(np.float32)
    colors = vertex_colors(views, mesh, grid.voxel)
    return HeadSurface(vertices, normals, faces, confidence, colors, grid, figures)


def vertex_colors(views: Sequence[DepthView], mesh: HeadMesh, lift: float) -> np.ndarray:
    """Average the views' colours per vertex (V, 3) uint8, weighted by the cosine squared.

    A view counts where it sees the point ``lift`` metres above the vertex.
    """
    weights = view_weights(views, mesh, lift) ** 2
    total = np.zeros((len(mesh.vertices), 3))
    for view, weight in zip(views, weights, strict=True):
        pixels, _ = project_fast(view.camera, mesh.vertices)
        total += weight[:, None] * bilinear(view.rgb.astype(np.float32), pixels)
    seen = weights.sum(0)
    mean = np.where(seen[:, None] > 0, total / np.maximum(seen, 1e-9)[:, None], 128.0)
    return np.rint(mean).clip(0, 255).astype(np.uint8)
