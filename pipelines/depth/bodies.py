"""Connected parts of what lies inside a grid's surface."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import scipy.sparse as sparse
from scipy.ndimage import label

from pipelines.depth.blocks import BLOCK, HELD, INSIDE, OUTSIDE, Grid, held, windows


def largest_body(grid: Grid) -> Grid:
    """The grid with only the largest connected inside; what floats beside it is outside."""
    parts, size = _inside_parts(grid)
    if np.count_nonzero(size) < 2:
        return grid
    largest = int(size.argmax())
    floats = (parts.blocks > 0) & (parts.blocks != largest)
    table = np.where(floats[:, 0, 0, 0][parts.table] & (grid.table == INSIDE), OUTSIDE, grid.table)
    blocks = grid.blocks.copy()
    blocks[HELD:][floats[HELD : len(blocks)]] = grid.voxel
    return Grid(grid.origin, grid.voxel, grid.shape, table.astype(np.int32), blocks)


def _inside_parts(grid: Grid) -> tuple[Grid, np.ndarray]:
    """Which connected part of the inside voxels are of, from 1, 0 outside; voxels (P,) of each.

    Parts are found within each block, then joined across the blocks' borders (26 neighbours).
    Blocks wholly inside that touch have a row in common, after the rows of the grid.
    """
    touching = np.ones((3, 3, 3))
    inside = np.pad(grid.blocks[HELD:] < 0, ((0, 0), (0, 1), (0, 1), (0, 1)))  # a wall after each
    own, count = label(inside.reshape(-1, BLOCK + 1, BLOCK + 1), touching)
    own = own.reshape(inside.shape)[:, :BLOCK, :BLOCK, :BLOCK]
    deep, deeps = label(grid.table == INSIDE, touching)
    full = np.broadcast_to(np.arange(1 + count, 1 + count + deeps)[:, None, None, None],
                           (deeps, BLOCK, BLOCK, BLOCK))  # fmt: skip
    blocks = np.concatenate([np.zeros((HELD, BLOCK, BLOCK, BLOCK), np.int32), own, full])
    table = np.where(deep > 0, len(grid.blocks) - 1 + deep, grid.table)
    parts = Grid(grid.origin, grid.voxel, grid.shape, table, blocks.astype(np.int32))
    total = 1 + count + deeps
    first, second = _touching(parts, held(grid)[own.any((1, 2, 3))], total)
    graph = sparse.coo_matrix((np.ones(len(first)), (first, second)), (total, total))
    joined = sparse.csgraph.connected_components(graph, directed=False)[1]
    size = np.bincount(joined[own.ravel()], minlength=joined.max() + 1)  # outside is part 0
    size[0] = 0
    np.add.at(size, joined[1 + count :], BLOCK**3 * np.bincount(deep.ravel())[1:])
    return replace(parts, blocks=joined[blocks]), size


def _touching(parts: Grid, places: np.ndarray, count: int) -> np.ndarray:
    """Pairs (2, N) of different parts, under ``count``, that neighbours in these blocks are of."""
    around = windows(parts, places, 1, 1).astype(np.int64)
    middle = around[:, 1:-1, 1:-1, 1:-1]
    found = []
    for x, y, z in product((0, 1, 2), repeat=3):
        other = around[:, x : x + BLOCK, y : y + BLOCK, z : z + BLOCK]
        key = (middle * count + other)[(middle != other) & (middle > 0) & (other > 0)]
        # runs of the same pair first: sorting all of them would take most of the time
        found.append(np.unique(key[np.diff(key, prepend=-1) != 0]))
    return np.stack(np.divmod(np.concatenate(found), count))
