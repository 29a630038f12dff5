"""The final surface of a grid: mesh, confidence and colours; how well views agree on a surface."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from express50.errors import StageError
from express50.geometry.raycast import mesh_scene
from pipelines.depth.blocks import VOXEL_LIMIT, Grid
from pipelines.depth.bodies import largest_body
from pipelines.depth.config import DepthConfig
from pipelines.depth.grid import View, hull_distance, project_fast, sample_image
from pipelines.depth.surface import extract_mesh, graph_laplacian, largest_part
from pipelines.depth.sweep import grey_images, sweep_scores, view_weights


@dataclass(frozen=True)
class Surface:
    """The reconstructed head.

    Attributes:
        vertices (V, 3), normals (V, 3): world, metres, outward.
        faces: (F, 3).
        confidence: (V,) in [0, 1]; agreement of the views, 0.3 where only silhouettes speak.
        colors: (V, 3) uint8 sRGB.
        grid: signed distances the mesh was taken from.
        numbers: voxels and agreement for the metrics.
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    confidence: np.ndarray
    colors: np.ndarray
    grid: Grid
    numbers: dict = field(default_factory=dict)


def finished(views: Sequence[View], grid: Grid, config: DepthConfig) -> Surface:
    """Mesh, confidence and colours of the final grid."""
    grid = largest_body(grid)
    vertices, normals, faces = extract_mesh(grid)
    if not len(faces):
        raise StageError(
            f"no surface is left on a grid of {config.voxel_mm} mm voxels; expected a head larger"
            " than a few voxels: check the mattes, or lower depth.voxel_mm"
        )
    faces = largest_part(vertices, faces)
    offsets = np.array([-1.0, 0.0, 1.0]) * grid.voxel
    agreement = patch_scores(views, grid, vertices, normals, faces, offsets, config)[:, 1]
    on_hull = np.abs(hull_distance(views, vertices)) < 0.5 * grid.voxel
    confidence = _averaged(np.clip(agreement, 0, 1), faces, rounds=6)
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    numbers = {
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
    confidence = np.maximum(confidence, np.where(on_hull, 0.3, 0.1)).astype(np.float32)
    colors = _colors(views, vertices, normals, faces, grid.voxel)
    return Surface(vertices, normals, faces, confidence, colors, grid, numbers)


def patch_scores(
    views: Sequence[View],
    grid: Grid,
    vertices: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray,
    offsets: np.ndarray,
    config: DepthConfig,
) -> np.ndarray:
    """How well the views agree (V, D) on patches moved by offsets (D,) along normals, metres."""
    spacing = 0.66 * grid.voxel
    pixel = np.median([pixel_size(view, vertices.mean(0)) for view in views])
    greys = grey_images(views, 0.4 * spacing / pixel)
    weights = view_weights(views, vertices, normals, mesh_scene(vertices, faces), grid.voxel)
    # the samples of a patch lie no closer than the pixels: finer ones would repeat them
    spacing = max(spacing, float(pixel))
    scores = sweep_scores(
        views, greys, grid, vertices, normals, weights, offsets, spacing, config.noise,
        config.patch_samples,
    )  # fmt: skip
    # neighbours see the same: chance matches of one patch, frequent in hair, average out
    return _averaged(scores, faces, rounds=1)


def pixel_size(view: View, point: np.ndarray) -> float:
    """Metres that a pixel spans at a world point (3,)."""
    M = view.camera.cam_from_world
    return float(abs(M[2, :3] @ point + M[2, 3]) / view.camera.K[0, 0])


def _averaged(values: np.ndarray, faces: np.ndarray, rounds: int) -> np.ndarray:
    """Vertex values (V,) or (V, D) averaged over their neighbours, again and again."""
    laplacian = graph_laplacian(faces, len(values))
    for _ in range(rounds):
        values = values - 0.5 * (laplacian @ values)
    return values


def _colors(
    views: Sequence[View], vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, lift: float
) -> np.ndarray:
    """Mean colour (V, 3) uint8 of the views that see a vertex, weighted by the cosine squared."""
    weights = view_weights(views, vertices, normals, mesh_scene(vertices, faces), lift) ** 2
    total = np.zeros((len(vertices), 3))
    for view, weight in zip(views, weights, strict=True):
        pixels, _ = project_fast(view.camera, vertices)
        for channel in range(3):
            plane = np.ascontiguousarray(view.rgb[..., channel], np.float32)
            total[:, channel] += weight * sample_image(plane, pixels)
    seen = weights.sum(0)
    mean = np.where(seen[:, None] > 0, total / np.maximum(seen, 1e-9)[:, None], 128.0)
    return np.rint(mean).clip(0, 255).astype(np.uint8)
