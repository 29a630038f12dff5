"""Photo-consistency of a surface: patches of it slid along the normals, compared across views.

A patch is curved as the surface is, so that views far apart see it alike: a fronto-parallel sweep
fails at the 35 to 45 degrees between neighbours of a sparse ring, a flat patch at a nose. The score
is zero-mean normalised cross-correlation, blind to each camera's gain and offset.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import open3d as o3d

from pipelines.depth.blocks import Grid
from pipelines.depth.grid import View, project_fast, sample_image

GRAZING = 0.25  # cosine; flatter than this, a patch is squeezed to under a quarter of its width


def grey_images(views: Sequence[View], blur_px: float) -> list[np.ndarray]:
    """Luma (H, W) float32, in 8-bit steps, of every view, blurred against aliasing."""
    greys = []
    for view in views:
        grey = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
        greys.append(cv2.GaussianBlur(grey, (0, 0), blur_px) if blur_px > 0.3 else grey)
    return greys


def view_weights(
    views: Sequence[View],
    vertices: np.ndarray,
    normals: np.ndarray,
    scene: o3d.t.geometry.RaycastingScene,
    lift: float,
) -> np.ndarray:
    """How well each view sees each vertex: (C, V) in [0, 1], the cosine to the normal, 0 if hidden.

    Args:
        views: C views.
        vertices: (V, 3) of the surface.
        normals: (V, 3) outward.
        scene: the surface.
        lift: metres; a vertex counts as seen where the point this far above it is.
    """
    weights = np.zeros((len(views), len(vertices)), np.float32)
    for row, view in zip(weights, views, strict=True):
        towards = view.camera.center - vertices
        distance = np.linalg.norm(towards, axis=1, keepdims=True)
        towards = towards / distance
        cosine = (normals * towards).sum(1)
        pixels, depth = project_fast(view.camera, vertices)
        size = np.array([view.camera.width, view.camera.height])
        seen = (cosine > GRAZING) & (depth > 0) & ((pixels > 2) & (pixels < size - 2)).all(1)
        seen[seen] = sample_image(view.alpha, pixels[seen]) > 0.9
        rays = np.concatenate([vertices + lift * (normals + towards), towards], axis=1)[seen]
        hidden = scene.test_occlusions(o3d.core.Tensor(rays.astype(np.float32)), nthreads=1)
        seen[seen] = ~hidden.numpy()
        row[seen] = cosine[seen]
    return weights


def sweep_scores(
    views: Sequence[View],
    greys: Sequence[np.ndarray],
    grid: Grid,
    vertices: np.ndarray,
    normals: np.ndarray,
    weights: np.ndarray,
    offsets: np.ndarray,
    spacing: float,
    noise: float,
    side: int = 5,
) -> np.ndarray:
    """Cross-correlation (V, D) in [-1, 1] at every offset along the normal; 0 under two views.

    Args:
        views: C views.
        greys: their (H, W) float32 images.
        grid: signed distances, which say how the surface curves about a vertex.
        vertices: (V, 3) of the surface.
        normals: (V, 3) outward.
        weights: (C, V) of :func:`view_weights`.
        offsets: (D,) metres along the normal.
        spacing: metres between a patch's samples.
        noise: standard deviation, 8-bit steps, under which texture counts as none.
        side: samples along a patch's side.
    """
    scores = np.zeros((len(vertices), len(offsets)), np.float32)
    usable = np.flatnonzero((weights > 0).sum(0) >= 2)
    tangents = _tangents(normals)  # (V, 2, 3)
    ticks = (np.arange(side) - (side - 1) / 2) * spacing
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
    grid: Grid, vertices: np.ndarray, normals: np.ndarray, tangents: np.ndarray, flat: np.ndarray
) -> np.ndarray:
    """Points (n, P, 3) float32 about each vertex, on the surface over the places (P, 2) of a plane.

    Where the surface leaves the plane by more than the plane's extent it is another part of it.
    """
    about = flat @ tangents  # (n, P, 3)
    height = grid.sample((vertices[:, None] + about).reshape(-1, 3)).reshape(about.shape[:2])
    reach = np.abs(flat).max()
    rise = np.where(np.abs(height) < reach, -height, 0.0)
    return (about + rise[..., None] * normals[:, None]).astype(np.float32)


def _tangents(normals: np.ndarray) -> np.ndarray:
    """Two orthonormal vectors (V, 2, 3) across each normal (V, 3)."""
    axis = np.where(np.abs(normals[:, 1:2]) < 0.8, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(normals, axis)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-9)
    return np.stack([first, np.cross(normals, first)], axis=1)


def _correlate(
    views: Sequence[View],
    greys: Sequence[np.ndarray],
    line: np.ndarray,
    patch: np.ndarray,
    weights: np.ndarray,
    noise: float,
) -> np.ndarray:
    """Weighted mean correlation (n, D) over all pairs of views of patches (n, P, 3) along lines.

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
        z = sample_image(grey, pixels.reshape(-1, 2)).reshape(pixels.shape[:3])
        z -= z.mean(-1, keepdims=True)
        power = np.einsum("ndp,ndp->nd", z, z)
        share = weight[seen, None] / np.sqrt(power + count * noise * noise)
        total[seen] += z * share[..., None]
        own[seen] += power * share * share
    pairs = weights.sum(0) ** 2 - (weights**2).sum(0)
    return (np.einsum("ndp,ndp->nd", total, total) - own) / np.maximum(pairs, 1e-9)[:, None]


def _patch_pixels(view: View, line: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """Pixels (n, D, P, 2) float32 of patches; affine within one, which spans 1 % of its depth."""
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
