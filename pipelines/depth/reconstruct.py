"""Reconstruct a surface from views: visual hull, tracked mesh, photo-consistency.

Patches of the surface slide along its normals and are compared across views. They are curved as the
surface is, so that views far apart see them alike: a fronto-parallel sweep fails at the 35 to 45
degrees between neighbours of a sparse ring, flat patches at a nose. The score is zero-mean
normalised cross-correlation, which ignores each camera's gain and offset. Tracking has a search of
its own with other supports and scores (docs/LOG.md, Depth).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from scipy.spatial import cKDTree

from express50.errors import StageError
from express50.geometry.conventions import corner_to_cell
from express50.geometry.meshes import mesh_parts
from express50.geometry.raycast import join_rays, mesh_scene
from express50.geometry.sampling import bilinear
from express50.geometry.transforms import unit
from pipelines.depth.blocks import (
    BLOCK,
    HELD,
    VOXEL_LIMIT,
    LevelSet,
    assemble,
    at,
    build,
    combined,
    held,
    refined,
    voxel_index,
)
from pipelines.depth.prior import TrackedSolid
from pipelines.depth.surface import (
    HeadMesh,
    HeadSurface,
    advance,
    averaged,
    extract_mesh,
    fair,
    graph_laplacian,
    rim_targets,
    smooth_displacement,
)
from pipelines.depth.views import (
    UNSEEN,
    DepthView,
    head_box,
    hull_distance,
    in_picture,
    pixel_size,
    project_fast,
)

COARSE_M = 0.006  # voxel of the first level: it spans the gap between hull and face
LEVEL_RATIO = 1.47  # of the voxels of one level to those of the next
INWARD_M = 0.03  # how far below the hull the first level searches: eye sockets are that deep
FAIR_VOXELS = 1.4  # smoothing before each level; less gains 0.012 mm but fails with three views
SMALLEST_M, LARGEST_M = 0.03, 3.0  # a head is 0.25 m high, with shoulders under 1 m
HULL_CONFIDENCE = 0.3  # where only silhouettes are evidence
LEAST_CONFIDENCE = 0.1  # where nothing is; also that of a tracked head in a single view
GRAZING = 0.25  # cosine; flatter than this, a patch is squeezed to under a quarter of its width
SAMPLES = 5  # along a patch's side: 7 are worse (0.353 for 0.333 mm)
SPACING_VOXELS = 0.66  # between a patch's samples


def reconstruct(
    views: Sequence[DepthView],
    solid: TrackedSolid | None = None,
    voxel_mm: float = 1.6,
    voxel_px: float = 1.4,
    noise: float = 0.8,
) -> HeadSurface:
    """Reconstruct the surface that two or more views share, from the tracked mesh if there is one.

    The numbers are the settings of those names (`DepthConfig`).

    Raises:
        StageError: the mattes share no volume, or the box or surface is too large for the voxel.
    """
    low, high = head_box(views)
    extent = float(np.linalg.norm(high - low))
    fine = finest_voxel(views, (low + high) / 2, voxel_mm, voxel_px)
    _check_size(low, high, fine)
    coarser = np.log(COARSE_M / fine) / np.log(LEVEL_RATIO)
    voxels = [fine * LEVEL_RATIO**k for k in reversed(range(1 + max(0, round(coarser))))]
    outlines = [] if solid is None else solid.outlines(views)
    clear = views if solid is None else solid.without_glasses(views)

    def room(points: np.ndarray) -> np.ndarray:
        hull = hull_distance(views, points)
        return hull if solid is None else solid.carved(points, hull)

    def start(points: np.ndarray) -> np.ndarray:
        hull = room(points)
        return hull if solid is None else solid.merge(points, hull, outlines, 2 * voxels[0])

    grid = build(low, high, voxels[0], start)
    for level, voxel in enumerate(voxels):
        if grid.voxel != voxel:
            grid = refined(grid, voxel)
        hull = _hull_near(room, grid)
        grid = combined(np.maximum, grid, hull)
        if solid is None or level:
            grid = fair(grid, FAIR_VOXELS * voxel)
        if level == 0 and solid is None:  # the surface may lie deep below the hull
            offsets = np.arange(-INWARD_M, 1.01 * voxel, voxel / 2)
        else:
            offsets = np.arange(-2.0, 2.01, 0.4) * voxel
        grid = combined(np.maximum, _moved(clear, grid, extent, offsets, noise), hull)
    return _finished(views, clear, grid, noise)


def tracked_surface(
    view: DepthView, solid: TrackedSolid, voxel_mm: float, voxel_px: float, noise: float
) -> HeadSurface:
    """Take the tracked head unchanged: a single view has no other evidence of depth."""
    voxel = finest_voxel([view], (solid.low + solid.high) / 2, voxel_mm, voxel_px)
    low, high = solid.low - 4 * voxel, solid.high + 4 * voxel
    _check_size(low, high, voxel)
    grid = build(low, high, voxel, solid.distance, steepest=1.0)  # exact distances
    return _finished([view], [view], grid, noise)


def finest_voxel(
    views: Sequence[DepthView], middle: np.ndarray, voxel_mm: float, voxel_px: float
) -> float:
    """Choose the voxel of the last level, metres, as fine as the pixels at a point (3,) allow."""
    pixel = float(np.median([pixel_size(view, middle) for view in views]))
    return max(voxel_mm * 1e-3, voxel_px * pixel)


def _check_size(low: np.ndarray, high: np.ndarray, voxel: float) -> None:
    """Refuse a box with corners (3,), (3,) unlike a head in metres, or too large to hold."""
    extent = float((high - low).max())
    blocks = float(np.prod((high - low) / (BLOCK * voxel)))
    if blocks > VOXEL_LIMIT or not SMALLEST_M <= extent <= LARGEST_M:
        size = " x ".join(f"{side:.3g}" for side in high - low)
        raise StageError(
            f"the head's box is {size} m, {blocks:.2g} blocks of voxels of {voxel * 1e3:g} mm;"
            f" expected {SMALLEST_M:g} to {LARGEST_M:g} m and at most {VOXEL_LIMIT:.2g} blocks: is"
            " the calibration in metres? If it is, raise depth.voxel_mm"
        )


def _hull_near(hull_of: Callable[[np.ndarray], np.ndarray], grid: LevelSet) -> LevelSet:
    """Take distances to the hull near the grid's surface; elsewhere they are inside."""

    def values(places: np.ndarray) -> np.ndarray:
        near = np.abs(at(grid, places)) < 4 * grid.voxel
        hull = np.full(near.shape, -UNSEEN, np.float32)
        hull[near] = hull_of(grid.points(voxel_index(places)[near]))
        return hull

    inside = np.ones(grid.table.shape, bool)
    return assemble(grid.origin, grid.voxel, grid.shape, inside, held(grid), values)


def _moved(
    views: Sequence[DepthView], grid: LevelSet, extent: float, offsets: np.ndarray, noise: float
) -> LevelSet:
    """Move the surface once: slide patches by offsets (D,), metres, solve for a displacement.

    Silhouettes pull as hard as a perfect match; ``extent`` is the box's diagonal, metres.
    """
    mesh = extract_mesh(grid)
    if not len(mesh.faces):
        return grid
    weights = view_weights(views, mesh, grid.voxel)
    scores = patch_scores(views, weights, grid, mesh, offsets, noise)
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
    displacement = smooth_displacement(scores, offsets, laplacian, pinned, weight)
    return advance(grid, mesh.vertices, displacement)


def _finished(
    views: Sequence[DepthView], clear: Sequence[DepthView], grid: LevelSet, noise: float
) -> HeadSurface:
    """Take mesh, confidence and colours from the final grid; `clear` views are compared."""
    mesh = extract_mesh(grid)
    if not len(mesh.faces):
        raise StageError(
            f"no surface is left on a grid of {grid.voxel * 1e3:.3g} mm voxels; expected a head"
            " larger than a few voxels: check the mattes, or lower depth.voxel_mm"
        )
    part = mesh_parts(mesh.faces, len(mesh.vertices))[mesh.faces[:, 0]]
    # Smaller parts are not the head.
    mesh = mesh._replace(faces=mesh.faces[part == np.bincount(part).argmax()])
    weights = view_weights(clear, mesh, grid.voxel)
    agreement = patch_scores(clear, weights, grid, mesh, np.zeros(1), noise)[:, 0]
    confidence = averaged(np.clip(agreement, 0, 1), mesh.faces, rounds=6)
    used, faces = np.unique(mesh.faces, return_inverse=True)
    vertices, agreement, confidence = mesh.vertices[used], agreement[used], confidence[used]
    on_hull = np.abs(hull_distance(views, vertices)) < 0.5 * grid.voxel
    figures = {
        "voxel_mm": grid.voxel * 1e3,
        "voxels_allocated": grid.blocks[HELD:].size,
        "voxels_dense": math.prod(grid.shape),
        "voxel_limit": VOXEL_LIMIT,
        "grid_bytes": grid.blocks.nbytes + grid.table.nbytes,
        "photo_agreement_median": float(np.median(agreement)),
    }
    floor = np.where(on_hull, HULL_CONFIDENCE, LEAST_CONFIDENCE)
    confidence = np.maximum(confidence, floor).astype(np.float32)
    if clear is not views:
        weights = view_weights(views, mesh, grid.voxel)
    colors, normals = vertex_colors(views, weights, mesh)[used], mesh.normals[used]
    return HeadSurface(vertices, normals, faces.reshape(-1, 3), confidence, colors, grid, figures)


def vertex_colors(views: Sequence[DepthView], weights: np.ndarray, mesh: HeadMesh) -> np.ndarray:
    """Average the views' colours per vertex (V, 3) uint8, by the squares of weights (C, V)."""
    total, seen = np.zeros((len(mesh.vertices), 3)), (weights**2).sum(0)
    for view, weight in zip(views, weights, strict=True):
        shown = weight > 0
        pixels, _ = project_fast(view.camera, mesh.vertices[shown])
        colours = bilinear(view.rgb.astype(np.float32), pixels)
        total[shown] += weight[shown, None] ** 2 * colours
    mean = np.where(seen[:, None] > 0, total / np.maximum(seen, 1e-9)[:, None], 128.0)
    return np.rint(mean).clip(0, 255).astype(np.uint8)


def patch_scores(
    views: Sequence[DepthView],
    weights: np.ndarray,
    grid: LevelSet,
    mesh: HeadMesh,
    offsets: np.ndarray,
    noise: float,
) -> np.ndarray:
    """Score how well the views agree (V, D) on patches moved along normals by offsets (D,) metres.

    Views count by their `view_weights` (C, V). Scores are correlations in [-1, 1], averaged over
    neighbours; 0 where under two views see the vertex.
    """
    vertices, normals, faces = mesh
    spacing = SPACING_VOXELS * grid.voxel
    pixel = np.median([pixel_size(view, vertices.mean(0)) for view in views])
    greys = grey_images(views, 0.4 * spacing / pixel)
    # Samples of a patch lie no closer than the pixels: finer ones would repeat them.
    ticks = (np.arange(SAMPLES) - (SAMPLES - 1) / 2) * max(spacing, float(pixel))
    flat = np.stack(np.meshgrid(ticks, ticks), -1).reshape(-1, 2)
    axis = np.where(np.abs(normals[:, 1:2]) < 0.8, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    first = unit(np.cross(normals, axis))
    tangents = np.stack([first, np.cross(normals, first)], axis=1)  # (V, 2, 3), orthonormal
    scores = np.zeros((len(vertices), len(offsets)), np.float32)
    usable = np.flatnonzero((weights > 0).sum(0) >= 2)
    for chunk in np.array_split(usable, max(1, len(usable) // 1000)):
        line = vertices[chunk, None] + normals[chunk, None] * offsets[:, None]  # (n, D, 3)
        # Patches (n, P, 3) follow the surface, unless it is further off than they are wide.
        about = flat @ tangents[chunk]
        around = (vertices[chunk, None] + about).reshape(-1, 3)
        height = grid.sample(around).reshape(about.shape[:2])
        rise = np.where(np.abs(height) < np.abs(flat).max(), -height, 0.0)
        patch = (about + rise[..., None] * normals[chunk, None]).astype(np.float32)
        scores[chunk] = _correlate(views, greys, line, patch, weights[:, chunk] ** 2, noise)
    # Averages out chance matches of single patches, which are frequent in hair.
    return averaged(scores, faces, rounds=1)


def grey_images(views: Sequence[DepthView], blur_px: float) -> list[np.ndarray]:
    """Convert views to luma (H, W) float32, in 8-bit steps, blurred against aliasing."""
    greys = []
    for view in views:
        grey = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
        greys.append(cv2.GaussianBlur(grey, (0, 0), blur_px) if blur_px > 0.3 else grey)
    return greys


def view_weights(views: Sequence[DepthView], mesh: HeadMesh, lift: float) -> np.ndarray:
    """Weigh each vertex in each view, (C, V) in [0, 1]: the cosine to the normal, 0 if hidden.

    A vertex counts as seen if the point ``lift`` metres above it is.
    """
    vertices, normals = mesh.vertices, mesh.normals.astype(np.float32)
    scene = mesh_scene(vertices, mesh.faces)
    weights = np.zeros((len(views), len(vertices)), np.float32)
    for row, view in zip(weights, views, strict=True):
        towards = (view.camera.center - vertices).astype(np.float32)
        towards /= np.sqrt(np.einsum("vi,vi->v", towards, towards))[:, None]
        cosine = np.einsum("vi,vi->v", normals, towards)
        pixels, depth = project_fast(view.camera, vertices)
        seen = (cosine > GRAZING) & in_picture(view.camera, pixels, depth, inset=2)
        seen[seen] = bilinear(view.alpha, pixels[seen]) > 0.9
        rays = join_rays(vertices[seen] + lift * (normals + towards)[seen], towards[seen])
        seen[seen] = ~scene.test_occlusions(rays, nthreads=1).numpy()
        row[seen] = cosine[seen]
    return weights


def _correlate(
    views: Sequence[DepthView],
    greys: Sequence[np.ndarray],
    line: np.ndarray,
    patch: np.ndarray,
    weights: np.ndarray,
    noise: float,
) -> np.ndarray:
    """Average the correlation (n, D) of patches (n, P, 3) along lines over all pairs of views.

    Lines (n, D, 3) hold the patches' centres. With z_c the normalised patch of view c, the mean is
    (|sum w_c z_c|^2 - sum w_c^2 |z_c|^2) / ((sum w_c)^2 - sum w_c^2).
    """
    count = patch.shape[1]
    total = np.zeros((*line.shape[:2], count), np.float32)
    own = np.zeros(line.shape[:2], np.float32)
    mean = np.full(count, 1 / count, np.float32)
    for view, grey, weight in zip(views, greys, weights, strict=True):
        seen = weight > 0
        if not seen.any():
            continue
        z = _patch_values(view, grey, line[seen], patch[seen])
        z -= (z @ mean)[..., None]
        power = np.einsum("ndp,ndp->nd", z, z)
        share = weight[seen, None] / np.sqrt(power + count * noise * noise)
        total[seen] += z * share[..., None]
        own[seen] += power * share * share
    pairs = weights.sum(0) ** 2 - (weights**2).sum(0)
    return (np.einsum("ndp,ndp->nd", total, total) - own) / np.maximum(pairs, 1e-9)[:, None]


def _patch_values(
    view: DepthView, grey: np.ndarray, line: np.ndarray, patch: np.ndarray
) -> np.ndarray:
    """Interpolate a view (H, W) at patches: (n, D, P).

    They are small: one is pictured alike, by an affine map, all along its line.
    """
    M = (view.camera.K @ view.camera.cam_from_world[:3, :3]).astype(np.float32)
    # Vertices come last, for long inner loops.
    center = ((line - view.camera.center).astype(np.float32) @ M.T).T[:, :, None]  # (3, D, 1, n)
    along = np.ascontiguousarray((patch @ M.T).T)  # (3, P, n)
    inverse = 1 / np.maximum(center[2], np.float32(1e-6))
    middle = len(inverse) // 2
    maps = []
    for axis in range(2):
        place = center[axis] * inverse
        shape = (along[axis] - place[middle] * along[2]) * inverse[middle]  # (P, n)
        maps.append((corner_to_cell(place) + shape).reshape(-1, len(patch)))
    found = cv2.remap(grey, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.ascontiguousarray(found.reshape(-1, *along.shape[1:]).transpose(2, 0, 1))
