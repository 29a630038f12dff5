"""Dense arrays to grids of blocks and back, to compare them with SciPy's filters."""

from __future__ import annotations

import numpy as np

from pipelines.depth.blocks import BLOCK, Grid, assemble, voxel_index


def from_dense(origin: np.ndarray, voxel: float, values: np.ndarray) -> Grid:
    """A grid of distances (X, Y, Z); its border is closed and what is far is not held."""
    size = tuple(-(-n // BLOCK) for n in values.shape)
    last = np.array(values.shape) - 1
    places = np.argwhere(np.ones(size, bool))
    return assemble(
        np.asarray(origin, np.float64), voxel, values.shape, np.zeros(size, bool), places,
        lambda part: values[tuple(np.moveaxis(np.minimum(voxel_index(part), last), -1, 0))],
    )  # fmt: skip


def to_dense(grid: Grid) -> np.ndarray:
    """All values (X, Y, Z) of the box."""
    return trimmed(grid, grid.blocks[grid.table].transpose(0, 3, 1, 4, 2, 5))


def is_held(grid: Grid) -> np.ndarray:
    """Which voxels (X, Y, Z) are held in a block."""
    rows = grid.table[:, None, :, None, :, None] * np.ones((1, BLOCK, 1, BLOCK, 1, BLOCK), int)
    return trimmed(grid, rows) > 1


def trimmed(grid: Grid, values: np.ndarray) -> np.ndarray:
    whole = values.reshape([BLOCK * n for n in grid.table.shape])
    return whole[tuple(slice(0, n) for n in grid.shape)]
