"""From views to one surface: visual hull, tracked mesh, photo-consistency, coarse to fine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from express50.errors import StageError
from express50.raycast import mesh_scene
from pipelines.depth.config import DepthConfig
from pipelines.depth.grid import (
    UNSEEN,
    Grid,
    View,
    head_box,
    hull_distance,
    project_fast,
    sample_image,
)
from pipelines.depth.prior import Prior
from pipelines.depth.refine import refine
from pipelines.depth.surface import (
    advance,
    closed,
    extract_mesh,
    fair,
    graph_laplacian,
    largest_body,
    largest_part,
    refined,
    rim_targets,
    smooth_displacement,
)
from pipelines.depth.sweep import grey_images, sweep_scores, view_weights

LEVEL_RATIO = 1.47
COUPLINGS = (1e3, 3e3, 1e4, 2e4)  # per square metre; a gap of 10 mm costs 0.1 at first, 2 at last
VOXEL_LIMIT = 60_000_000
LARGEST_M = 3.0  # a head with shoulders is a third of it


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


def reconstruct(views: Sequence[View], config: DepthConfig, prior: Prior | None = None) -> Surface:
    """Reconstruct the surface that the views share.

    Args:
        views: usable views, at least two.
        config: the knobs.
        prior: the tracked mesh, or None.

    Raises:
        StageError: the mattes share no volume, or the box is too large for the voxel.
    """
    low, high = head_box(views)
    extent = float(np.linalg.norm(high - low))
    voxels = _voxels(views, (low + high) / 2, config)
    _check_size(low, high, voxels[-1])
    grid = _initial(views, low, high, voxels[0], prior)
    for level, voxel in enumerate(voxels):
        if level:
            grid = refined(grid, voxel)
        hull = _hull(views, grid)
        grid = _within_hull(grid, hull)
        if prior is None or level:
            grid = fair(grid, config.fair_voxels * voxel)
        grid = _move(views, grid, hull, config, extent, first=level == 0 and prior is None)
    grid, rendered = refine(views, grid, config)
    surface = _finish(views, grid, config)
    return replace(surface, numbers=surface.numbers | rendered)


def _voxels(views: Sequence[View], middle: np.ndarray, config: DepthConfig) -> list[float]:
    """Voxels of the levels, metres, coarse to fine; the last as fine as the pixels allow."""
    pixel = float(np.median([_pixel_size(view, middle) for view in views]))
    fine = max(config.voxel_mm * 1e-3, config.voxel_px * pixel)
    coarser = np.log(config.coarse_mm * 1e-3 / fine) / np.log(LEVEL_RATIO)
    return [fine * LEVEL_RATIO**k for k in reversed(range(1 + max(0, round(coarser))))]


def _check_size(low: np.ndarray, high: np.ndarray, voxel: float) -> None:
    count = float(np.prod((high - low) / voxel))
    if count > VOXEL_LIMIT or (high - low).max() > LARGEST_M:
        size = " x ".join(f"{side:.2f}" for side in high - low)
        raise StageError(
            f"the head's box is {size} m, {count:.2g} voxels of {voxel * 1e3:g} mm; expected at"
            f" most {LARGEST_M:g} m and {VOXEL_LIMIT:.2g} voxels: is the calibration in metres?"
            " else raise depth.voxel_mm"
        )


def _initial(
    views: Sequence[View], low: np.ndarray, high: np.ndarray, voxel: float, prior: Prior | None
) -> Grid:
    """Distances to the visual hull, and to the tracked mesh where that is known."""
    grid = hull_grid(views, low, high, voxel)
    return grid if prior is None else prior.merge(grid)


def hull_grid(views: Sequence[View], low: np.ndarray, high: np.ndarray, voxel: float) -> Grid:
    """Signed distances to the visual hull in a box with these corners (3,), metres."""
    shape = np.ceil((high - low) / voxel).astype(int) + 1
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    return Grid(low, voxel, closed(hull_distance(views, low + voxel * index).reshape(shape)))


def _hull(views: Sequence[View], grid: Grid) -> np.ndarray:
    """Distances (X, Y, Z) to the visual hull near the grid's surface, far inside elsewhere."""
    band = np.abs(grid.values) < 4 * grid.voxel
    hull = np.full(grid.values.shape, -UNSEEN, np.float32)
    hull[band] = hull_distance(views, grid.points(np.argwhere(band)))
    return hull


def _within_hull(grid: Grid, hull: np.ndarray) -> Grid:
    """The grid cut by distances (X, Y, Z) to the visual hull."""
    return Grid(grid.origin, grid.voxel, closed(np.maximum(grid.values, hull)))


def _move(
    views: Sequence[View],
    grid: Grid,
    hull: np.ndarray,
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
        scores = _scores(views, grid, vertices, normals, faces, offsets, config)
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
    return _within_hull(advance(grid, vertices, displacement), hull)


def _offsets(config: DepthConfig, voxel: float, first: bool) -> np.ndarray:
    """Offsets (D,) along the normal, metres: from deep below a hull, else a few voxels around."""
    if first:
        return np.arange(-config.inward_mm * 1e-3, 1.01 * voxel, voxel / 2)
    return np.arange(-2.0, 2.01, 0.4) * voxel


def _scores(
    views: Sequence[View],
    grid: Grid,
    vertices: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray,
    offsets: np.ndarray,
    config: DepthConfig,
) -> np.ndarray:
    spacing = 0.66 * grid.voxel
    pixel = np.median([_pixel_size(view, vertices.mean(0)) for view in views])
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


def _pixel_size(view: View, point: np.ndarray) -> float:
    """Metres that a pixel spans at a world point (3,)."""
    M = view.camera.cam_from_world
    return float(abs(M[2, :3] @ point + M[2, 3]) / view.camera.K[0, 0])


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


def _finish(views: Sequence[View], grid: Grid, config: DepthConfig) -> Surface:
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
    agreement = _scores(views, grid, vertices, normals, faces, offsets, config)[:, 1]
    on_hull = np.abs(hull_distance(views, vertices)) < 0.5 * grid.voxel
    confidence = _averaged(np.clip(agreement, 0, 1), faces, rounds=6)
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    numbers = {
        "voxel_mm": grid.voxel * 1e3,
        "voxels": int(grid.values.size),
        "voxels_near_surface": int((np.abs(grid.values) < 4 * grid.voxel).sum()),
        "vertices": int(used.sum()),
        "photo_agreement_median": float(np.median(agreement[used])),
        "photo_supported": float((confidence[used] > 0.3).mean()),
        "silhouette_supported": float(on_hull[used].mean()),
    }
    confidence = np.maximum(confidence, np.where(on_hull, 0.3, 0.1)).astype(np.float32)
    colors = _colors(views, vertices, normals, faces, grid.voxel)
    return Surface(vertices, normals, faces, confidence, colors, grid, numbers)


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
