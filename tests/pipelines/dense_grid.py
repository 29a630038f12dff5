"""Convert dense arrays to level sets and back, to compare them with SciPy's filters."""

from __future__ import annotations

import numpy as np

from pipelines.depth.blocks import BLOCK, LevelSet, assemble, voxel_index


def from_dense(origin: np.ndarray, voxel: float, values: np.ndarray) -> LevelSet:
    """Make a level set of distances (X, Y, Z): its border is closed, far blocks are not held."""
    size = tuple(-(-n // BLOCK) for n in values.shape)
    last = np.array(values.shape) - 1
    places = np.argwhere(np.ones(size, bool))
    return assemble(
        np.asarray(origin, np.float64), voxel, values.shape, np.zeros(size, bool), places,
        lambda part: values[tuple(np.moveaxis(np.minimum(voxel_index(part), last), -1, 0))],
    )  # fmt: skip


def to_dense(grid: LevelSet) -> np.ndarray:
    """List all values (X, Y, Z) of the box."""
    return trimmed(grid, grid.blocks[grid.table].transpose(0, 3, 1, 4, 2, 5))


def is_held(grid: LevelSet) -> np.ndarray:
    """Mark the voxels (X, Y, Z) that are held in a block."""
    rows = grid.table[:, None, :, None, :, None] * np.ones((1, BLOCK, 1, BLOCK, 1, BLOCK), int)
    return trimmed(grid, rows) > 1


def trimmed(grid: LevelSet, values: np.ndarray) -> np.ndarray:
    whole = values.reshape([BLOCK * n for n in grid.table.shape])
    return whole[tuple(slice(0, n) for n in grid.shape)]
