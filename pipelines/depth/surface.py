"""Move a surface: mesh a level set, find smooth displacements, update the level set."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.sparse.linalg import LinearOperator, cg
from skimage.measure import marching_cubes

from express50.geometry.cameras import unproject
from express50.geometry.conventions import cell_to_corner
from express50.geometry.meshes import edge_graph
from express50.geometry.transforms import unit
from pipelines.depth.blocks import (
    BLOCK,
    HELD,
    LevelSet,
    at,
    combined,
    held,
    replaced,
    smoothed,
    windows,
)
from pipelines.depth.views import DepthView

OUTLIER_STEPS = 2.0  # steps of offsets from the neighbours at which a match counts as a quarter
LEAST_VOXELS = 1e-3  # voxels; smaller distances are raised to this before meshing
STIFFNESS_VOXELS = 2.2  # length below which a thin plate smooths displacements
RIM_STEP_M = 0.01  # between the places that are tried first on a silhouette's ray: noses are wider
COUPLINGS = (1e3, 3e3, 1e4, 2e4)  # per square metre; a gap of 10 mm costs 0.1 at first, 2 at last


class HeadMesh(NamedTuple):
    """Vertices (V, 3) and outward normals (V, 3), world, metres; faces (F, 3)."""

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray


@dataclass(frozen=True)
class HeadSurface:
    """The reconstructed head: a mesh as HeadMesh, and the signed distances it was taken from."""

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    confidence: np.ndarray  # (V,) in [0, 1], 0.3 where only silhouettes are evidence
    colors: np.ndarray  # (V, 3) uint8 sRGB
    grid: LevelSet
    figures: dict = field(default_factory=dict)  # for the metrics


def extract_mesh(grid: LevelSet) -> HeadMesh:
    """Mesh the zero level by marching cubes; normals are the grid's gradient.

    Source: Lorensen and Cline 1987, through scikit-image. Blocks with the first voxels of the next
    ones are laid out as one volume; cubes across its seams are masked, and vertices that two blocks
    have on their common face become one.
    """
    ends = grid.blocks.min((1, 2, 3))[grid.table], grid.blocks.max((1, 2, 3))[grid.table]
    least = minimum_filter(ends[0], 2, origin=-1, mode="nearest")
    most = maximum_filter(ends[1], 2, origin=-1, mode="nearest")
    places = np.argwhere((least < 0) & (most > 0))
    if not len(places):
        return HeadMesh(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    # In a cube, not in a row: the vertices' indices are float32.
    tile, tiles = BLOCK + 1, math.ceil(len(places) ** (1 / 3))
    volume = np.ones((tiles**3, tile, tile, tile), np.float32)
    values, least = windows(grid, places, 0), np.float32(LEAST_VOXELS * grid.voxel)
    # Away from 0, so that each vertex lies clearly on one edge.
    volume[: len(places)] = np.where(np.abs(values) < least, np.copysign(least, values), values)
    volume = volume.reshape(tiles, tiles, tiles, tile, tile, tile).transpose(0, 3, 1, 4, 2, 5)
    inner = np.arange(tiles * tile) % tile > 0
    mask = inner[:, None, None] & inner[:, None] & inner
    found, faces, _, _ = marching_cubes(
        volume.reshape(mask.shape), 0.0, mask=mask, gradient_direction="descent"
    )
    which = (found // tile).astype(np.int64) @ [tiles * tiles, tiles, 1]
    index = found % tile + BLOCK * places[which]
    # Weld vertices, so that a voxel's edge has at most one. Those within a cube, which marching
    # cubes adds where faces are ambiguous, have no double.
    whole = np.floor(index).astype(np.int64)
    share = index > whole
    key = 3 * np.ravel_multi_index(tuple(whole.T), tuple(whole.max(0) + 1)) + share.argmax(1)
    lone = share.sum(1) > 1
    key[lone] = -1 - np.arange(lone.sum())
    _, first, welded = np.unique(key, return_index=True, return_inverse=True)
    index = index[first]
    return HeadMesh(grid.points(index), grid_normals(grid, index), welded[faces])


def grid_normals(grid: LevelSet, index: np.ndarray) -> np.ndarray:
    """Take unit gradients (N, 3) at fractional voxel indices (N, 3), smoothed by a voxel."""
    smooth = smoothed(grid, 1.0)
    slope = [
        smooth.sample(grid.points(index + e)) - smooth.sample(grid.points(index - e))
        for e in np.eye(3)
    ]
    return unit(np.stack(slope, axis=1).astype(np.float64))


def graph_laplacian(faces: np.ndarray, count: int) -> sparse.csc_matrix:
    """Build the random-walk Laplacian (V, V): each vertex minus the mean of its neighbours."""
    adjacent = edge_graph(faces, count)
    degree = np.maximum(np.asarray(adjacent.sum(1)).ravel(), 1.0)
    return (sparse.identity(count) - sparse.diags(1.0 / degree) @ adjacent).tocsc()


def averaged(values: np.ndarray, faces: np.ndarray, rounds: int) -> np.ndarray:
    """Average vertex values (V,) or (V, D) over their neighbours, repeatedly."""
    laplacian = graph_laplacian(faces, len(values))
    for _ in range(rounds):
        values = values - 0.5 * (laplacian @ values)
    return values


def rim_targets(views: Sequence[DepthView], grid: LevelSet, depth_range: float) -> np.ndarray:
    """Find the points (N, 3) where rays along the silhouettes pass closest to the surface.

    The grid's distance there is the displacement that the surface lacks.
    """
    step = 1.5 * grid.voxel
    # Distances are smooth: coarse steps find the region, and fine steps the place in it.
    some = int(np.clip(RIM_STEP_M / step, 1, 4))
    ends = 0.5 * depth_range
    steps = np.arange(-ends, ends, some * step), step * np.arange(1 - some, some)
    middle = grid.points((np.array(grid.shape) - 1) / 2)
    found = []
    for view in views:
        edge = (view.silhouette_px > 0) & (view.silhouette_px <= 1.0) & (view.alpha > 0)
        edge[[0, -1]] = edge[:, [0, -1]] = False
        y, x = np.nonzero(edge)
        if not len(x):
            continue
        # Pixel centres are moved along the gradient to distance 0.
        signed = view.silhouette_px
        dx = (signed[y, x + 1] - signed[y, x - 1]) / 2
        dy = (signed[y + 1, x] - signed[y - 1, x]) / 2
        scale = signed[y, x] / np.maximum(dx * dx + dy * dy, 0.25)
        pixels = cell_to_corner(np.stack([x - dx * scale, y - dy * scale], axis=1))
        depths = (view.camera.cam_from_world[:3, :3] @ middle)[2] + view.camera.cam_from_world[2, 3]
        ray = unproject(view.camera, pixels, np.ones(len(x))) - view.camera.center
        best = np.full(len(x), depths)
        for about in steps:
            tried = best[:, None] + about
            points = view.camera.center + ray[:, None] * tried[..., None]
            least = grid.sample(points.reshape(-1, 3)).reshape(tried.shape).argmin(1)
            best = tried[np.arange(len(x)), least]
        found.append(view.camera.center + ray * best[:, None])
    return np.concatenate(found) if found else np.zeros((0, 3))


def smooth_displacement(
    scores: np.ndarray,
    offsets: np.ndarray,
    laplacian: sparse.csc_matrix,
    pinned: np.ndarray,
    pinned_weight: np.ndarray,
) -> np.ndarray:
    """Find displacements (V,), metres, that score well at offsets (D,) and bend little.

    Alternates between the best offset near the current displacement (scores (V, D) minus a coupling
    times the squared gap) and a linear solve of a thin plate through these offsets and the
    ``pinned`` ones (V,) (Steinbruecker et al. 2009; Newcombe et al. 2011).
    """
    peak, typical = scores.max(1), np.median(scores, axis=1)
    # A peak counts by its height and by how far it stands out: 0.33 on well textured skin.
    trust = np.clip(3.0 * np.clip(peak, 0, 1) * (peak - typical), 0, 1)
    bend = (STIFFNESS_VOXELS**2 * laplacian).astype(np.float32).tocsr()  # against a weight of one
    plate = bend, bend.T.tocsr()
    ridge = 0.01  # keeps patches without evidence in place
    rows, step = np.arange(len(scores)), offsets[1] - offsets[0]
    displacement = _plate(plate, ridge + trust + pinned_weight, pinned_weight * pinned, step)
    believed = trust
    for coupling in COUPLINGS:
        gap = offsets[None] - displacement[:, None]
        energy = scores - coupling * gap * gap
        best = energy.argmax(1)
        # The peak of the parabola through the best sample and its two neighbours.
        inner = np.clip(best, 1, energy.shape[1] - 2)
        left, mid, right = (energy[rows, inner + k] for k in (-1, 0, 1))
        bend = left - 2 * mid + right
        peak = np.where(bend < -1e-9, 0.5 * (left - right) / np.minimum(bend, -1e-9), 0.0)
        target = offsets[best] + np.where(best == inner, np.clip(peak, -0.5, 0.5), 0.0) * step
        pull = believed * target + pinned_weight * pinned
        displacement = _plate(plate, ridge + believed + pinned_weight, pull, step, displacement)
        # A match that its neighbours contradict is due to chance (Geman and McClure 1985).
        believed = trust / (1.0 + ((target - displacement) / (OUTLIER_STEPS * step)) ** 2) ** 2
    return displacement


def _plate(
    plate: tuple[sparse.csr_matrix, sparse.csr_matrix],
    weight: np.ndarray,
    pull: np.ndarray,
    step: float,
    start: np.ndarray | None = None,
) -> np.ndarray:
    """Solve for the displacements (V,) of a plate on springs (V,), to 1 % of a step.

    The plate is its bending (V, V) and the transpose: their product would have more entries.
    """
    (bend, turned), springs = plate, weight.astype(np.float32)
    matrix = LinearOperator(bend.shape, lambda x: turned @ (bend @ x) + springs * x, dtype="f4")
    inverse = sparse.diags(1 / (np.asarray(turned.power(2).sum(1)).ravel() + springs))
    tolerance = 1e-2 * step * float(weight.mean()) * len(weight) ** 0.5
    pull = pull.astype(np.float32)
    return cg(matrix, pull, start, rtol=0.0, atol=tolerance, maxiter=2000, M=inverse)[0]


def advance(grid: LevelSet, vertices: np.ndarray, displacement: np.ndarray) -> LevelSet:
    """Move the grid's surface by ``displacement`` (V,) of its vertices (V, 3) along the normals.

    The displacement spreads into the grid as a normalised Gaussian average.
    """
    index = np.rint((vertices - grid.origin) / grid.voxel).astype(int)
    index = np.clip(index, 0, np.array(grid.shape) - 1)
    # Sums of weights at the vertices' voxels, zero elsewhere, in blocks of their own.
    places = tuple((index // BLOCK).T)
    table = np.zeros_like(grid.table)
    table[places] = HELD
    table[table == HELD] = HELD + np.arange((table == HELD).sum())
    inner = np.ravel_multi_index(tuple((index % BLOCK).T), (BLOCK,) * 3)
    voxels = table[places].astype(np.int64) * BLOCK**3 + inner
    size = (int(table.max()) + 1) * BLOCK**3
    spread = []
    for weight in (displacement, np.ones(len(index))):
        sums = np.bincount(voxels, weight, size).astype(np.float32)
        blocks = sums.reshape(-1, BLOCK, BLOCK, BLOCK)
        sparse = LevelSet(grid.origin, grid.voxel, grid.shape, table, blocks)
        spread.append(smoothed(sparse, sigma=1.2, truncate=7.0))

    def moved(values: np.ndarray, pull: np.ndarray, weight: np.ndarray) -> np.ndarray:
        known = weight > 1e-12
        return values - np.where(known, pull / np.where(known, weight, 1), 0)

    return combined(moved, grid, *spread)


def fair(grid: LevelSet, sigma: float) -> LevelSet:
    """Smooth a grid by a Gaussian of ``sigma`` metres and scale it back to unit slope."""
    smooth = smoothed(grid, sigma / grid.voxel)

    def values(places: np.ndarray) -> np.ndarray:
        own, around = at(grid, places), windows(smooth, places, 1)
        steps = np.gradient(around, grid.voxel, axis=(1, 2, 3))
        slope = np.sqrt(sum(g * g for g in steps))[:, 1:-1, 1:-1, 1:-1]
        smoothest = around[:, 1:-1, 1:-1, 1:-1] / np.clip(slope, 0.4, 2.0)
        return np.where(np.abs(own) < 3 * grid.voxel, smoothest, own)

    return replaced(grid, held(grid), values)
