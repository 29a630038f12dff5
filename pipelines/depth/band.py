"""Sparse band of voxel vertices about a surface: where values live, interpolation, neighbours.

Only vertices within a few voxels of the surface exist. Blocks of 8^3 voxels lead from a place to
its vertex in two gathers, a table of cells from there to the eight corners in one. Coordinates are
in voxels from the grid's origin, so that float32 suffices wherever the subject stands.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import binary_dilation

BLOCK = 8
CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
SIDES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])


@dataclass(frozen=True)
class Band:
    """M voxel vertices, found by block.

    Attributes:
        cells: (M, 3) int64 integer coordinates, sorted.
        low: (3,) int64 coordinates of the first block's first voxel.
        blocks: (X, Y, Z) int64 rank of a block, -1 where it holds no vertex.
        slots: (blocks * 512,) int64 vertex of each of a block's voxels, M where there is none.
        corners: (M + 1, 8) int64 vertices of the cell above each vertex, M where there is none.
        sides: (M, 6) int64 neighbours along +x -x +y -y +z -z, M where there is none.
    """

    cells: torch.Tensor
    low: torch.Tensor
    blocks: torch.Tensor
    slots: torch.Tensor
    corners: torch.Tensor
    sides: torch.Tensor

    @property
    def count(self) -> int:
        """Vertices M."""
        return len(self.cells)

    @property
    def bytes(self) -> int:
        """Bytes of all tables."""
        tables = (self.cells, self.blocks, self.slots, self.corners, self.sides)
        return sum(t.numel() * t.element_size() for t in tables)

    def find(self, cells: torch.Tensor) -> torch.Tensor:
        """Vertices (...) at integer coordinates (..., 3); M where there is none."""
        return _find(cells, self.low, self.blocks, self.slots, self.count)

    def interpolation(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Vertices (..., 8) and trilinear weights (..., 8) at points (..., 3), voxels.

        Absent corners weigh nothing and the others sum to one; all weigh nothing where the cell's
        own vertex is absent. Vertices stay below M, so that they may index values (M, ...).
        """
        base = torch.floor(points)
        part = points - base
        index = self.corners[self.find(base.long())]
        x, y, z = (torch.stack([1 - part[..., a], part[..., a]], -1) for a in range(3))
        product = x[..., :, None, None] * y[..., None, :, None] * z[..., None, None, :]
        weight = torch.where(index < self.count, product.flatten(-3), product.new_zeros(()))
        weight = weight / weight.sum(-1, keepdim=True).clamp_min(1e-6)
        return index.clamp_max(self.count - 1), weight


def _find(
    cells: torch.Tensor, low: torch.Tensor, blocks: torch.Tensor, slots: torch.Tensor, absent: int
) -> torch.Tensor:
    size = torch.tensor(blocks.shape, device=cells.device)
    moved = cells - low
    block = torch.div(moved, BLOCK, rounding_mode="floor")
    inside = ((block >= 0) & (block < size)).all(-1)
    block = torch.where(inside[..., None], block, torch.zeros_like(block))
    rank = blocks[block[..., 0], block[..., 1], block[..., 2]]
    local = moved.remainder(BLOCK)
    place = (local[..., 0] * BLOCK + local[..., 1]) * BLOCK + local[..., 2]
    known = inside & (rank >= 0)
    found = slots[torch.where(known, rank * BLOCK**3 + place, torch.zeros_like(place))]
    return torch.where(known, found, torch.full_like(found, absent))


def make_band(cells: np.ndarray, device: torch.device) -> Band:
    """The band of these integer coordinates (M, 3), in any order, at least one."""
    cells = np.unique(np.asarray(cells, np.int64), axis=0)
    low = (cells.min(0) // BLOCK) * BLOCK
    block = (cells - low) // BLOCK
    shape = tuple(block.max(0) + 1)
    flat = np.ravel_multi_index(tuple(block.T), shape)
    names, rank = np.unique(flat, return_inverse=True)
    blocks = np.full(int(np.prod(shape)), -1, np.int64)
    blocks[names] = np.arange(len(names))
    local = (cells - low) % BLOCK
    slots = np.full(len(names) * BLOCK**3, len(cells), np.int64)
    slots[rank * BLOCK**3 + (local[:, 0] * BLOCK + local[:, 1]) * BLOCK + local[:, 2]] = np.arange(
        len(cells)
    )
    tables = (low, blocks.reshape(shape), slots)
    start, ranks, places = (torch.from_numpy(table).to(device) for table in tables)
    at = torch.from_numpy(cells).to(device)
    corners, sides = (
        _find(at[:, None] + torch.from_numpy(steps).to(device), start, ranks, places, len(cells))
        for steps in (CORNERS, SIDES)
    )
    nowhere = corners.new_full((1, 8), len(cells))
    return Band(at, start, ranks, places, torch.cat([corners, nowhere]), sides)


def grown(cells: np.ndarray, rounds: int) -> np.ndarray:
    """Integer coordinates (N, 3) and all within ``rounds`` steps of them to any of 26 sides."""
    low = cells.min(0) - rounds
    filled = np.zeros(cells.max(0) - low + rounds + 1, bool)
    filled[tuple((cells - low).T)] = True
    filled = binary_dilation(filled, np.ones((3, 3, 3)), iterations=rounds)
    return np.argwhere(filled) + low


def roughness(band: Band, values: torch.Tensor) -> torch.Tensor:
    """Graph Laplacian (M, ...) of values (M, ...): each less the mean of its six neighbours.

    Symmetric: an absent neighbour counts as equal (no flow leaves the band).
    """
    padded = torch.cat([values, values.new_zeros(1, *values.shape[1:])])
    total = torch.zeros_like(values)
    for side in band.sides.unbind(1):
        total += padded[side]
    degree = (band.sides < band.count).sum(1).to(values.dtype)
    return (degree.reshape(-1, *[1] * (values.ndim - 1)) * values - total) / 6


def slopes(band: Band, values: torch.Tensor) -> torch.Tensor:
    """Central differences (M, 3) of values (M,), 0 along an axis that lacks a neighbour."""
    padded = torch.cat([values, values.new_zeros(1)])
    near = padded[band.sides].reshape(-1, 3, 2)
    return torch.where(both_sides(band), (near[..., 0] - near[..., 1]) / 2, near.new_zeros(()))


def slopes_transposed(band: Band, vectors: torch.Tensor) -> torch.Tensor:
    """Transpose (M,) of :func:`slopes` applied to vectors (M, 3), by gathers alone."""
    kept = torch.where(both_sides(band), vectors, vectors.new_zeros(()))
    padded = torch.cat([kept, kept.new_zeros(1, 3)])
    total = torch.zeros_like(vectors[:, 0])
    for axis in range(3):
        after, before = band.sides[:, 2 * axis], band.sides[:, 2 * axis + 1]
        total = total + (padded[before, axis] - padded[after, axis]) / 2
    return total


def both_sides(band: Band) -> torch.Tensor:
    """Whether a vertex has both neighbours (M, 3) along each axis."""
    return (band.sides.reshape(-1, 3, 2) < band.count).all(-1)
