"""The moving surface: meshes of a signed distance grid, smooth displacements, level-set updates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sparse
from scipy.ndimage import gaussian_filter, label, map_coordinates
from scipy.sparse.linalg import cg
from skimage.measure import marching_cubes

from express50.adapters import cell_to_corner
from express50.cameras import unproject
from pipelines.depth.grid import Grid, View

OUTLIER_STEPS = 2.0


def extract_mesh(grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3), outward normals (V, 3) and faces (F, 3) of the zero level.

    Source: Lorensen and Cline 1987, as scikit-image has it; normals are the grid's gradient.
    """
    if not (grid.values.min() < 0 < grid.values.max()):
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    index, faces, _, _ = marching_cubes(grid.values, 0.0, gradient_direction="descent")
    return grid.points(index), grid_normals(grid, index), faces.astype(np.int64)


def grid_normals(grid: Grid, index: np.ndarray) -> np.ndarray:
    """Unit gradient (N, 3) at fractional voxel indices (N, 3), from values smoothed by a voxel."""
    smooth = gaussian_filter(grid.values, 1.0)
    step = np.eye(3)
    slope = [
        map_coordinates(smooth, (index + e).T, order=1, mode="nearest")
        - map_coordinates(smooth, (index - e).T, order=1, mode="nearest")
        for e in step
    ]
    normals = np.stack(slope, axis=1)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def graph_laplacian(faces: np.ndarray, count: int) -> sparse.csc_matrix:
    """Random-walk Laplacian (V, V): each vertex less the mean of its neighbours."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ones = np.ones(len(edges))
    adjacent = sparse.coo_matrix((ones, (edges[:, 0], edges[:, 1])), (count, count)).tocsr()
    adjacent = ((adjacent + adjacent.T) > 0).astype(np.float64)
    degree = np.maximum(np.asarray(adjacent.sum(1)).ravel(), 1.0)
    return (sparse.identity(count) - sparse.diags(1.0 / degree) @ adjacent).tocsc()


def rim_targets(views: Sequence[View], grid: Grid, depth_range: float) -> np.ndarray:
    """Points (N, 3) where rays along the silhouettes pass closest to the surface.

    Such a point should lie on the surface: the grid's distance there is the displacement that the
    surface lacks (positive: it has shrunk away from the silhouette).
    """
    steps = np.arange(-0.5, 0.5, 1.5 * grid.voxel / depth_range) * depth_range
    middle = grid.points((np.array(grid.values.shape) - 1) / 2)
    found = []
    for view in views:
        edge = (view.silhouette_px > 0) & (view.silhouette_px <= 1.0)
        edge[[0, -1]] = edge[:, [0, -1]] = False
        y, x = np.nonzero(edge)
        if not len(x):
            continue
        pixels = _onto_contour(view.silhouette_px, x, y)
        center_depth = (view.camera.cam_from_world[:3, :3] @ middle)[2]
        center_depth += view.camera.cam_from_world[2, 3]
        near = unproject(view.camera, pixels, np.ones(len(x)))
        ray = near - view.camera.center
        depths = center_depth + steps
        points = view.camera.center + ray[:, None] * depths[None, :, None]
        values = grid.sample(points.reshape(-1, 3)).reshape(len(x), -1)
        best = values.argmin(1)
        found.append(points[np.arange(len(x)), best])
    return np.concatenate(found) if found else np.zeros((0, 3))


def _onto_contour(signed: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Corner-origin pixels (N, 2) moved from pixel centres along the gradient to distance 0."""
    dx = (signed[y, x + 1] - signed[y, x - 1]) / 2
    dy = (signed[y + 1, x] - signed[y - 1, x]) / 2
    scale = signed[y, x] / np.maximum(dx * dx + dy * dy, 0.25)
    return cell_to_corner(np.stack([x - dx * scale, y - dy * scale], axis=1))


def smooth_displacement(
    scores: np.ndarray,
    offsets: np.ndarray,
    laplacian: sparse.csc_matrix,
    pinned: np.ndarray,
    pinned_weight: np.ndarray,
    stiffness: float,
    couplings: Sequence[float],
    outlier_steps: float = OUTLIER_STEPS,
) -> tuple[np.ndarray, np.ndarray]:
    """Displacements (V,) that score well and bend little, and the trust (V,) in the scores.

    Alternates between the best offset near the current displacement (score less a coupling times
    the squared gap, exhaustive) and a linear solve of a thin plate through these offsets and the
    pinned ones (Steinbruecker et al. 2009; Newcombe et al. 2011).

    Args:
        scores: (V, D) photo-consistency at the offsets.
        offsets: (D,) metres, evenly spaced.
        laplacian: (V, V) of the mesh.
        pinned: (V,) displacements known otherwise, metres.
        pinned_weight: (V,) their weights.
        stiffness: weight of the squared Laplacian against a data weight of one.
        couplings: per-metre-squared weights of the alternations, rising.
        outlier_steps: offsets' steps off its neighbours at which a match is believed by a quarter.
    """
    count = len(scores)
    peak, typical = scores.max(1), np.median(scores, axis=1)
    # a peak counts by its height and by how far it stands out; 0.33 is what good texture gives
    trust = np.clip(3.0 * np.clip(peak, 0, 1) * (peak - typical), 0, 1)
    plate = stiffness * (laplacian.T @ laplacian)
    ridge = 0.01  # a patch that nothing pins stays where it is
    rows = np.arange(count)
    step = offsets[1] - offsets[0]
    displacement = _plate(plate, ridge + trust + pinned_weight, pinned_weight * pinned, step)
    believed = trust
    for coupling in couplings:
        gap = offsets[None] - displacement[:, None]
        energy = scores - coupling * gap * gap
        best = energy.argmax(1)
        target = offsets[best] + _parabola(energy, rows, best) * step
        pull = believed * target + pinned_weight * pinned
        displacement = _plate(plate, ridge + believed + pinned_weight, pull, step, displacement)
        # A match that its neighbours contradict is by chance (Geman and McClure 1985).
        believed = trust / (1.0 + ((target - displacement) / (outlier_steps * step)) ** 2) ** 2
    return displacement, trust


def _plate(
    plate: sparse.csc_matrix,
    weight: np.ndarray,
    pull: np.ndarray,
    step: float,
    start: np.ndarray | None = None,
) -> np.ndarray:
    """Displacements (V,) of a plate held by springs (V,), to a thousandth of a step."""
    matrix = (plate + sparse.diags(weight)).tocsr()
    inverse = sparse.diags(1.0 / matrix.diagonal())
    tolerance = 1e-3 * step * float(weight.mean()) * len(weight) ** 0.5
    found, _ = cg(matrix, pull, start, rtol=0.0, atol=tolerance, maxiter=2000, M=inverse)
    return found


def _parabola(energy: np.ndarray, rows: np.ndarray, best: np.ndarray) -> np.ndarray:
    """Offset in [-0.5, 0.5] of the peak of the parabola through the best sample and its two."""
    inner = np.clip(best, 1, energy.shape[1] - 2)
    left, mid, right = (energy[rows, inner + k] for k in (-1, 0, 1))
    bend = left - 2 * mid + right
    peak = np.where(bend < -1e-9, 0.5 * (left - right) / np.minimum(bend, -1e-9), 0.0)
    return np.where(best == inner, np.clip(peak, -0.5, 0.5), 0.0)


def advance(grid: Grid, vertices: np.ndarray, displacement: np.ndarray) -> Grid:
    """The grid after its surface moved by ``displacement`` (V,) along the normals.

    The displacement spreads from the surface into the grid as a normalised Gaussian average; a
    voxel out of its reach lies far from the old and the new surface and stays.
    """
    index = np.rint((vertices - grid.origin) / grid.voxel).astype(int)
    index = np.ravel_multi_index(
        tuple(np.clip(index, 0, np.array(grid.values.shape) - 1).T), grid.values.shape
    )
    size = grid.values.size
    spread = [
        gaussian_filter(
            np.bincount(index, weight, size).reshape(grid.values.shape).astype(float),
            sigma=1.2,
            truncate=7.0,
        )
        for weight in (displacement, None)
    ]
    known = spread[1] > 1e-12
    values = grid.values.copy()
    values[known] -= (spread[0][known] / spread[1][known]).astype(np.float32)
    return Grid(grid.origin, grid.voxel, values)


def fair(grid: Grid, sigma: float) -> Grid:
    """The grid smoothed by a Gaussian of ``sigma`` metres and scaled back to unit slope."""
    clipped = np.clip(grid.values, -8 * grid.voxel, 8 * grid.voxel)
    smooth = gaussian_filter(clipped, sigma / grid.voxel, mode="nearest")
    slope = np.sqrt(sum(g * g for g in np.gradient(smooth, grid.voxel)))
    near = np.abs(clipped) < 3 * grid.voxel
    values = np.where(near, smooth / np.clip(slope, 0.4, 2.0), clipped)
    return Grid(grid.origin, grid.voxel, values.astype(np.float32))


def refined(grid: Grid, voxel: float) -> Grid:
    """The same distances on a grid of another voxel size: cubic near the surface, else nearest."""
    extent = (np.array(grid.values.shape) - 1) * grid.voxel
    shape = np.ceil(extent / voxel - 1e-6).astype(int) + 1
    clipped = np.clip(grid.values, -8 * grid.voxel, 8 * grid.voxel)
    ratio = voxel / grid.voxel
    axes = [np.minimum(np.rint(np.arange(n) * ratio).astype(int), m - 1)
            for n, m in zip(shape, grid.values.shape, strict=True)]  # fmt: skip
    values = clipped[np.ix_(*axes)]
    near = np.argwhere(np.abs(values) < 3 * grid.voxel)
    # mode "nearest" with a prefilter would copy the whole grid; the band holds a tenth of it
    values[tuple(near.T)] = map_coordinates(clipped, near.T * ratio, order=3, mode="mirror")
    return Grid(grid.origin, voxel, values)


def closed(values: np.ndarray) -> np.ndarray:
    """Distances whose border voxels are outside, so that the surface is closed; in place."""
    for axis in range(3):
        edge = np.moveaxis(values, axis, 0)
        edge[0] = np.maximum(edge[0], 1e-4)
        edge[-1] = np.maximum(edge[-1], 1e-4)
    return values


def largest_body(grid: Grid) -> Grid:
    """The grid with only the largest connected inside; what floats beside it is outside."""
    inside = grid.values < 0
    labels, count = label(inside, structure=np.ones((3, 3, 3)))
    if count < 2:
        return grid
    largest = 1 + int(np.bincount(labels.ravel())[1:].argmax())
    values = np.where(inside & (labels != largest), np.float32(grid.voxel), grid.values)
    return Grid(grid.origin, grid.voxel, values)


def largest_part(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces (F', 3) of the largest connected part: a head is one; what floats beside it is not."""
    graph = sparse.coo_matrix(
        (np.ones(len(faces) * 2), (faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel())),
        (len(vertices), len(vertices)),
    )
    part = sparse.csgraph.connected_components(graph, directed=False)[1][faces[:, 0]]
    return faces[part == np.bincount(part).argmax()]
