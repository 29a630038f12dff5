"""Slide patches of a surface along its normals and compare them across views.

A patch is curved as the surface is, so that views far apart see it alike: a fronto-parallel sweep
fails at the 35 to 45 degrees between neighbours of a sparse ring, a flat patch at a nose. The score
is zero-mean normalised cross-correlation, which ignores each camera's gain and offset.

Tracking searches along normals too, with other supports and scores (docs/LOG.md, Depth).
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import open3d as o3d

from express50.geometry.raycast import mesh_scene
from express50.geometry.sampling import bilinear
from pipelines.depth.blocks import LevelSet
from pipelines.depth.surface import HeadMesh, averaged
from pipelines.depth.views import DepthView, pixel_size, project_fast

GRAZING = 0.25  # cosine; flatter than this, a patch is squeezed to under a quarter of its width
SAMPLES = 5  # along a patch's side: 7 are worse (0.353 for 0.333 mm)
SPACING_VOXELS = 0.66  # between a patch's samples


def patch_scores(
    views: Sequence[DepthView], grid: LevelSet, mesh: HeadMesh, offsets: np.ndarray, noise: float
) -> np.ndarray:
    """Score how well the views agree (V, D) on patches moved along normals by offsets (D,) metres.

    ``noise`` is that of :func:`sweep_scores`.
    """
    spacing = SPACING_VOXELS * grid.voxel
    pixel = np.median([pixel_size(view, mesh.vertices.mean(0)) for view in views])
    greys = grey_images(views, 0.4 * spacing / pixel)
    weights = view_weights(views, mesh, grid.voxel)
    # Samples of a patch lie no closer than the pixels: finer ones would repeat them.
    spacing = max(spacing, float(pixel))
    scores = sweep_scores(
        views, greys, grid, mesh.vertices, mesh.normals, weights, offsets, spacing, noise
    )
    # Neighbours see the same: chance matches of one patch, frequent in hair, average out.
    return averaged(scores, mesh.faces, rounds=1)


def grey_images(views: Sequence[DepthView], blur_px: float) -> list[np.ndarray]:
    """Convert views to luma (H, W) float32, in 8-bit steps, blurred against aliasing."""
    greys = []
    for view in views:
        grey = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
        greys.append(cv2.GaussianBlur(grey, (0, 0), blur_px) if blur_px > 0.3 else grey)
    return greys


def view_weights(views: Sequence[DepthView], mesh: HeadMesh, lift: float) -> np.ndarray:
    """Weigh each vertex in each view, (C, V) in [0, 1]: the cosine to the normal, 0 if hidden.

    Args:
        views: C views.
        mesh: the surface.
        lift: metres; a vertex counts as seen if the point this far above it is.
    """
    vertices, normals, _ = mesh
    scene = mesh_scene(vertices, mesh.faces)
    weights = np.zeros((len(views), len(vertices)), np.float32)
    for row, view in zip(weights, views, strict=True):
        towards = view.camera.center - vertices
        distance = np.linalg.norm(towards, axis=1, keepdims=True)
        towards = towards / distance
        cosine = (normals * towards).sum(1)
        pixels, depth = project_fast(view.camera, vertices)
        size = np.array([view.camera.width, view.camera.height])
        seen = (cosine > GRAZING) & (depth > 0) & ((pixels > 2) & (pixels < size - 2)).all(1)
        seen[seen] = bilinear(view.alpha, pixels[seen]) > 0.9
        rays = np.concatenate([vertices + lift * (normals + towards), towards], axis=1)[seen]
        hidden = scene.test_occlusions(o3d.core.Tensor(rays.astype(np.float32)), nthreads=1)
        seen[seen] = ~hidden.numpy()
        row[seen] = cosine[seen]
    return weights


def sweep_scores(
    views: Sequence[DepthView],
    greys: Sequence[np.ndarray],
    grid: LevelSet,
    vertices: np.ndarray,
    normals: np.ndarray,
    weights: np.ndarray,
    offsets: np.ndarray,
    spacing: float,
    noise: float,
) -> np.ndarray:
    """Correlate views (V, D) in [-1, 1] at each offset along the normal; 0 with under two views.

    Args:
        views: C views.
        greys: their (H, W) float32 images.
        grid: signed distances, from which patches take their curvature.
        vertices: (V, 3) of the surface.
        normals: (V, 3) outward.
        weights: (C, V) of :func:`view_weights`.
        offsets: (D,) metres along the normal.
        spacing: metres between a patch's samples.
        noise: standard deviation, 8-bit steps, under which texture does not count.
    """
    scores = np.zeros((len(vertices), len(offsets)), np.float32)
    usable = np.flatnonzero((weights > 0).sum(0) >= 2)
    axis = np.where(np.abs(normals[:, 1:2]) < 0.8, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(normals, axis)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-9)
    tangents = np.stack([first, np.cross(normals, first)], axis=1)  # (V, 2, 3), orthonormal
    ticks = (np.arange(SAMPLES) - (SAMPLES - 1) / 2) * spacing
    flat = np.stack(np.meshgrid(ticks, ticks), -1).reshape(-1, 2)
    for chunk in np.array_split(usable, max(1, len(usable) // 1000)):
        if not len(chunk):
            continue
        line = vertices[chunk, None] + normals[chunk, None] * offsets[:, None]  # (n, D, 3)
        weight = weights[:, chunk] ** 2
        patch = _patches(grid, vertices[chunk], normals[chunk], tangents[chunk], flat)
        scores[chunk] = _correlate(views, greys, line, patch, weight, noise)
    return scores


def _patches(
    grid: LevelSet,
    vertices: np.ndarray,
    normals: np.ndarray,
    tangents: np.ndarray,
    flat: np.ndarray,
) -> np.ndarray:
    """Lay points (n, P, 3) float32 around vertices, over places (P, 2) of their tangent planes.

    The points follow the surface, except where it is further off than the patch is wide.
    """
    about = flat @ tangents  # (n, P, 3)
    height = grid.sample((vertices[:, None] + about).reshape(-1, 3)).reshape(about.shape[:2])
    reach = np.abs(flat).max()
    rise = np.where(np.abs(height) < reach, -height, 0.0)
    return (about + rise[..., None] * normals[:, None]).astype(np.float32)


def _correlate(
    views: Sequence[DepthView],
    greys: Sequence[np.ndarray],
    line: np.ndarray,
    patch: np.ndarray,
    weights: np.ndarray,
    noise: float,
) -> np.ndarray:
    """Average the correlation (n, D) of patches (n, P, 3) along lines over all pairs of views.

    Lines (n, D, 3) hold the patches' centres. With z_c the normalised patch of view c, the sum over
    pairs is
    (|sum w_c z_c|^2 - sum w_c^2 |z_c|^2) / ((sum w_c)^2 - sum w_c^2).
    """
    count = patch.shape[1]
    total = np.zeros((*line.shape[:2], count), np.float32)
    own = np.zeros(line.shape[:2], np.float32)
    for view, grey, weight in zip(views, greys, weights, strict=True):
        seen = weight > 0
        if not seen.any():
            continue
        pixels = _patch_pixels(view, line[seen], patch[seen])
        z = bilinear(grey, pixels.reshape(-1, 2)).reshape(pixels.shape[:3])
        z -= z.mean(-1, keepdims=True)
        power = np.einsum("ndp,ndp->nd", z, z)
        share = weight[seen, None] / np.sqrt(power + count * noise * noise)
        total[seen] += z * share[..., None]
        own[seen] += power * share * share
    pairs = weights.sum(0) ** 2 - (weights**2).sum(0)
    return (np.einsum("ndp,ndp->nd", total, total) - own) / np.maximum(pairs, 1e-9)[:, None]


def _patch_pixels(view: DepthView, line: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """Project patches to pixels (n, D, P, 2) float32: affine within one, 1 % of its depth wide."""
    M = (view.camera.K @ view.camera.cam_from_world[:3, :3]).astype(np.float32)
    p = (line - view.camera.center).astype(np.float32) @ M.T  # (n, D, 3)
    depth = np.maximum(p[..., 2], 1e-6)
    along = patch @ M.T  # (n, P, 3)
    pixels = np.empty((*line.shape[:2], patch.shape[1], 2), np.float32)
    for axis in range(2):
        center = p[..., axis] / depth
        moved = along[:, None, :, axis] - center[..., None] * along[:, None, :, 2]
        pixels[..., axis] = center[..., None] + moved / depth[..., None]
    return pixels
