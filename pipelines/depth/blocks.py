"""Signed distances in blocks of voxels: held near the surface only, so memory follows its area.

A table names for every block of the box a row of an array of blocks. Two of the rows are constant
and shared by all blocks that lie wholly outside or inside. Source: Nießner et al. 2013 and Museth
2013, with a plain table in the place of a hash or a tree: it has a 512th of the box's voxels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from scipy.ndimage import (
    binary_dilation,
    generate_binary_structure,
    maximum_filter,
    minimum_filter,
)

from express50.errors import StageError

BLOCK = 8  # voxels along a block's side
SHIFT = 3  # its binary logarithm
BAND = 8.0  # voxels from the surface beyond which distances are constant
OUTSIDE, INSIDE, HELD = 0, 1, 2  # rows of the constant blocks and the first row of the others
VOXEL_LIMIT = 60_000_000
BORDER = 1e-4  # metres; the least distance on the box's border, which closes a surface cut by it
CHUNK = 1024  # blocks worked on at a time
STEEPEST = 2.0  # how fast a function given to `build` may change, metres a metre

Values = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Grid:
    """Signed distances, metres, negative inside, at origin + voxel * i in a box of voxels.

    Attributes:
        origin: (3,) world, metres.
        voxel: metres.
        shape: voxels (X, Y, Z) of the box.
        table: (A, B, C) int32, the row of every block of the box.
        blocks: (2 + N, BLOCK, BLOCK, BLOCK) float32, within BAND voxels of the surface; the rows
            after the constant two are in the order of their places in the table.
    """

    origin: np.ndarray
    voxel: float
    shape: tuple[int, int, int]
    table: np.ndarray
    blocks: np.ndarray

    @property
    def allocated(self) -> int:
        """Voxels held; a dense array would hold the product of ``shape``."""
        return self.blocks[HELD:].size

    @property
    def nbytes(self) -> int:
        """Bytes of the blocks and the table."""
        return self.blocks.nbytes + self.table.nbytes

    def points(self, index: np.ndarray) -> np.ndarray:
        """World points (N, 3) of fractional voxel indices (N, 3)."""
        return self.origin + self.voxel * index

    def sample(self, points: np.ndarray) -> np.ndarray:
        """Trilinear distances (N,) float32 at world points (N, 3), clamped to the box's border."""
        out = np.empty(len(points), np.float32)
        last = np.array(self.shape) - 1
        for start in range(0, len(points), 1 << 15):  # what the nearest cache holds
            part = slice(start, start + (1 << 15))
            out[part] = self._trilinear(
                np.clip((points[part] - self.origin) / self.voxel, 0, last), last
            )
        return out

    def _trilinear(self, index: np.ndarray, last: np.ndarray) -> np.ndarray:
        """Values (N,) at fractional voxel indices (N, 3) within the box."""
        low = np.minimum(index.astype(np.int32), np.maximum(last - 1, 0).astype(np.int32))
        _, b, c = self.table.shape
        block = low >> SHIFT
        row = self._plain.take(block[:, 0] * (b * c) + block[:, 1] * c + block[:, 2])
        out = self.blocks[:HELD, 0, 0, 0].take(row & 1)  # right where the surface is far
        near = np.flatnonzero(row < 0)
        low = low[near]
        share = (index[near] - low).astype(np.float32)
        found = np.zeros(len(near), np.float32)
        ends = []  # of each axis, low and high: offsets in the table and in a block, weight
        for axis, (stride, step) in enumerate(zip((b * c, c, 1), (64, 8, 1), strict=True)):
            at, weight = low[:, axis], share[:, axis]
            ends.append([((i >> SHIFT) * stride, (i & (BLOCK - 1)) * step, w)
                         for i, w in ((at, 1 - weight), (at + 1, weight))])  # fmt: skip
        table, voxels = self.table.ravel(), self.blocks.ravel()
        for x, y, z in product(*ends):
            rows = table.take(x[0] + y[0] + z[0]).astype(np.int64)
            found += voxels.take(rows * BLOCK**3 + (x[1] + y[1] + z[1])) * (x[2] * y[2] * z[2])
        out[near] = found
        return out

    @cached_property
    def _plain(self) -> np.ndarray:
        """Row (A * B * C,) of blocks that are constant like all that follow them, else -1."""
        least = minimum_filter(self.table, 2, mode="nearest", origin=-1)
        most = maximum_filter(self.table, 2, mode="nearest", origin=-1)
        return np.where((least == most) & (most < HELD), most, -1).astype(np.int8).ravel()


def held(grid: Grid) -> np.ndarray:
    """Places (N, 3) in the table of the blocks held, in the order of their rows."""
    return np.argwhere(grid.table >= HELD)


def at(grid: Grid, places: np.ndarray) -> np.ndarray:
    """Blocks (M, BLOCK, BLOCK, BLOCK) at places (M, 3) of the table."""
    return grid.blocks[grid.table[tuple(places.T)]]


def voxel_index(places: np.ndarray) -> np.ndarray:
    """Voxel indices (M, BLOCK, BLOCK, BLOCK, 3) of the blocks at places (M, 3)."""
    inner = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), -1)
    return places[:, None, None, None] * BLOCK + inner


def assemble(
    origin: np.ndarray, voxel: float, shape: tuple[int, int, int], inside: np.ndarray,
    places: np.ndarray, values: Values,
) -> Grid:  # fmt: skip
    """A grid of ``values`` at ``places``; blocks that are constant there are not held.

    Args:
        origin: (3,) world, metres.
        voxel: metres.
        shape: voxels (X, Y, Z) of the box.
        inside: (A, B, C) whether a block at no place is inside.
        places: (M, 3) in the table's order.
        values: distances (m, BLOCK, BLOCK, BLOCK), metres, of places (m, 3).

    Raises:
        StageError: more than VOXEL_LIMIT voxels would be held.
    """
    far = float(np.float32(BAND * voxel))
    table = inside.astype(np.int32)
    constant = np.empty((HELD, BLOCK, BLOCK, BLOCK), np.float32)
    constant[OUTSIDE], constant[INSIDE] = far, -far
    blocks, count = [constant], HELD
    for part in _chunks(places):
        found = np.clip(values(part), -far, far).astype(np.float32, copy=False)
        _close(found, part, shape, far)
        near = (found.min((1, 2, 3)) < far) & (found.max((1, 2, 3)) > -far)
        rows = np.where(found[:, 0, 0, 0] < 0, INSIDE, OUTSIDE)
        rows[near] = count + np.arange(near.sum())
        table[tuple(part.T)] = rows
        blocks.append(found[near])
        count += len(blocks[-1])
        _check_budget((count - HELD) * BLOCK**3, voxel)
    return Grid(origin, voxel, shape, table, np.concatenate(blocks))


def _chunks(places: np.ndarray) -> Iterator[np.ndarray]:
    for start in range(0, len(places), CHUNK):
        yield places[start : start + CHUNK]


def _close(values: np.ndarray, places: np.ndarray, shape: tuple[int, int, int], far: float) -> None:
    """Make the box's border, and the voxels of its last blocks beyond it, outside; in place."""
    for axis in range(3):
        index = BLOCK * places[:, axis, None] + np.arange(BLOCK)
        last = shape[axis] - 1
        side = np.moveaxis(values, axis + 1, 1)
        for outside, least in (((index == 0) | (index == last), BORDER), (index > last, far)):
            hit = np.nonzero(outside)
            side[hit] = np.maximum(side[hit], np.float32(least))


def _check_budget(voxels: int, voxel: float) -> None:
    if voxels > VOXEL_LIMIT:
        raise StageError(
            f"the surface takes more than {VOXEL_LIMIT:.2g} voxels of {voxel * 1e3:.3g} mm near it,"
            " expected a head, which takes 3 million of 1.6 mm: is the calibration in metres? else"
            " raise depth.voxel_mm or depth.voxel_px"
        )


def box_shape(extent: np.ndarray, voxel: float) -> tuple[int, int, int]:
    """Voxels (X, Y, Z) of a box whose sides are (3,) metres long."""
    x, y, z = np.ceil(extent / voxel - 1e-6).astype(int) + 1
    return int(x), int(y), int(z)


def build(low: np.ndarray, high: np.ndarray, voxel: float, distance: Values) -> Grid:
    """The grid of ``distance``, metres, of points (N, 3), in the box with corners (3,), (3,).

    Blocks are chosen by the distance at their middles. Where it jumps, signs of neighbours differ
    without a surface between: these are evaluated too, until none is left.
    """
    shape = box_shape(high - low, voxel)
    size = tuple(-(-n // BLOCK) for n in shape)
    places = np.stack(np.meshgrid(*map(np.arange, size), indexing="ij"), -1).reshape(-1, 3)
    middle = low + voxel * (places * BLOCK + (BLOCK - 1) / 2)
    parts = np.array_split(middle, 1 + len(middle) // 100_000)
    guess = np.concatenate([distance(part) for part in parts]).reshape(size)
    to_corner = 3**0.5 * (BLOCK - 1) / 2
    wanted = np.abs(guess) < (BAND + STEEPEST * to_corner) * voxel
    border = np.ones(size, bool)
    border[1:-1, 1:-1, 1:-1] = False
    wanted |= border & (guess < 0)

    def values(part: np.ndarray) -> np.ndarray:
        index = voxel_index(part)
        return distance(low + voxel * index.reshape(-1, 3)).reshape(index.shape[:-1])

    grid = assemble(low, voxel, shape, guess < 0, np.argwhere(wanted), values)
    while (torn := _torn(grid) & ~wanted).any():
        wanted |= torn
        grid = _grown(grid, torn, values)
    return grid


def _grown(grid: Grid, more: np.ndarray, values: Values) -> Grid:
    """The grid with the values of blocks (A, B, C) that it does not hold."""

    def either(part: np.ndarray) -> np.ndarray:
        found, new = at(grid, part), more[tuple(part.T)]
        if new.any():
            found[new] = values(part[new])
        return found

    return replaced(grid, np.argwhere((grid.table >= HELD) | more), either)


def _torn(grid: Grid) -> np.ndarray:
    """Blocks (A, B, C) that have both signs in them or in their neighbours across a face."""
    near = generate_binary_structure(3, 1)
    least = minimum_filter(grid.blocks.min((1, 2, 3))[grid.table], footprint=near)
    most = maximum_filter(grid.blocks.max((1, 2, 3))[grid.table], footprint=near)
    return (least < 0) & (most > 0)


def combined(function: Callable[..., np.ndarray], grid: Grid, *others: Grid) -> Grid:
    """The grid of a function of several grids' values, wherever any of them holds blocks.

    All have the same box and voxel; elsewhere the first one's sign stays.
    """
    grids = (grid, *others)
    places = np.argwhere(np.any([g.table >= HELD for g in grids], axis=0))
    return replaced(grid, places, lambda part: function(*(at(g, part) for g in grids)))


def replaced(grid: Grid, places: np.ndarray, values: Values) -> Grid:
    """The grid with other values at places (M, 3), which hold at least all blocks held so far."""
    inside = grid.table == INSIDE
    return assemble(grid.origin, grid.voxel, grid.shape, inside, places, values)


def windows(grid: Grid, places: np.ndarray, before: int, after: int) -> np.ndarray:
    """Blocks at places (M, 3) with so many voxels of their neighbours: (M, S, S, S), any dtype."""
    side = before + BLOCK + after
    out = np.empty((len(places), side, side, side), grid.blocks.dtype)
    spans = ((-1, slice(BLOCK - before, BLOCK), slice(0, before)),
             (0, slice(0, BLOCK), slice(before, before + BLOCK)),
             (1, slice(0, after), slice(before + BLOCK, side)))  # fmt: skip
    padded = np.pad(grid.table, 1)  # beyond the box is outside
    for x, y, z in product([span for span in spans if span[1] != slice(BLOCK, BLOCK)], repeat=3):
        rows = padded[tuple((places + [1 + x[0], 1 + y[0], 1 + z[0]]).T)]
        out[:, x[2], y[2], z[2]] = grid.blocks[:, x[1], y[1], z[1]][rows]
    return out


def dilated(grid: Grid) -> Grid:
    """The same values with the blocks around those held held too."""
    wanted = binary_dilation(grid.table >= HELD, np.ones((3, 3, 3)))
    blocks = np.concatenate([grid.blocks[:HELD], grid.blocks[grid.table[wanted]]])
    table = grid.table.copy()
    table[wanted] = HELD + np.arange(len(blocks) - HELD)
    return Grid(grid.origin, grid.voxel, grid.shape, table, blocks)
