"""Hold signed distances in blocks of voxels near the surface, so that memory follows its area.

A table gives every block of the box a row in an array of blocks. Two rows are constant and shared
by all blocks that lie wholly outside or wholly inside. Source: Nießner et al. 2013 and Museth 2013,
with a plain table instead of a hash or a tree, as it has a 512th of the box's voxels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from scipy.ndimage import binary_dilation, generate_binary_structure, maximum_filter, minimum_filter

from express50.errors import StageError

BLOCK = 8  # voxels along a block's side
SHIFT = 3  # its binary logarithm
BAND = 8.0  # voxels from the surface beyond which distances are constant
OUTSIDE, INSIDE, HELD = 0, 1, 2  # rows of the constant blocks and the first row of the others
VOXEL_LIMIT = 60_000_000
BORDER = 1e-4  # metres; the least distance on the box's border, which closes a surface cut by it
CHUNK = 1024  # blocks worked on at a time
STEEPEST = 2.0  # how fast hulls and what is merged with them change, metres per metre

Values = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class LevelSet:
    """Signed distances, metres, negative inside, at origin + voxel * i in a box of voxels."""

    origin: np.ndarray  # (3,) world, metres
    voxel: float  # metres
    shape: tuple[int, int, int]  # voxels (X, Y, Z) of the box
    table: np.ndarray  # (A, B, C) int32, the row of each block of the box
    # (2 + N, BLOCK, BLOCK, BLOCK) float32, within BAND voxels of the surface; the rows after the
    # constant two are in the order of their places in the table
    blocks: np.ndarray

    def points(self, index: np.ndarray) -> np.ndarray:
        """Convert fractional voxel indices (N, 3) to world points (N, 3)."""
        return self.origin + self.voxel * index

    def sample(self, points: np.ndarray) -> np.ndarray:
        """Interpolate distances (N,) float32 at world points (N, 3), clamped to the box."""
        out = np.empty(len(points), np.float32)
        last = np.array(self.shape) - 1
        _, b, c = self.table.shape
        table, voxels = self.table.ravel(), self.blocks.ravel()
        for start in range(0, len(points), 1 << 15):  # as many as fit into the nearest cache
            part = slice(start, start + (1 << 15))
            index = np.clip((points[part] - self.origin) / self.voxel, 0, last)
            low = np.minimum(index.astype(np.int32), np.maximum(last - 1, 0).astype(np.int32))
            block = low >> SHIFT
            row = self._constant_row.take(block[:, 0] * (b * c) + block[:, 1] * c + block[:, 2])
            out[part] = self.blocks[:HELD, 0, 0, 0].take(row & 1)  # correct far from the surface
            near = np.flatnonzero(row < 0)
            low = low[near]
            share = (index[near] - low).astype(np.float32)
            found = np.zeros(len(near), np.float32)
            ends = []  # of each axis, low and high: offsets in the table and in a block, weight
            for axis, (stride, step) in enumerate(zip((b * c, c, 1), (64, 8, 1), strict=True)):
                at, weight = low[:, axis], share[:, axis]
                ends.append([((i >> SHIFT) * stride, (i & (BLOCK - 1)) * step, w)
                             for i, w in ((at, 1 - weight), (at + 1, weight))])  # fmt: skip
            for x, y, z in product(*ends):
                rows = table.take(x[0] + y[0] + z[0]).astype(np.int64)
                found += voxels.take(rows * BLOCK**3 + (x[1] + y[1] + z[1])) * (x[2] * y[2] * z[2])
            out[start + near] = found
        return out

    @cached_property
    def _constant_row(self) -> np.ndarray:
        """Return rows (A * B * C,) of blocks that are constant, as all after them are, else -1."""
        least = minimum_filter(self.table, 2, mode="nearest", origin=-1)
        most = maximum_filter(self.table, 2, mode="nearest", origin=-1)
        return np.where((least == most) & (most < HELD), most, -1).astype(np.int8).ravel()


def held(grid: LevelSet) -> np.ndarray:
    """List the places (N, 3) in the table of the blocks held, in the order of their rows."""
    return np.argwhere(grid.table >= HELD)


def at(grid: LevelSet, places: np.ndarray) -> np.ndarray:
    """Take the blocks (M, BLOCK, BLOCK, BLOCK) at places (M, 3) of the table."""
    return grid.blocks[grid.table[tuple(places.T)]]


def voxel_index(places: np.ndarray) -> np.ndarray:
    """List the voxel indices (M, BLOCK, BLOCK, BLOCK, 3) of the blocks at places (M, 3)."""
    inner = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), -1)
    return places[:, None, None, None] * BLOCK + inner


def assemble(
    origin: np.ndarray, voxel: float, shape: tuple[int, int, int], inside: np.ndarray,
    places: np.ndarray, values: Values,
) -> LevelSet:  # fmt: skip
    """Make a grid of ``values`` at ``places``; blocks that are constant there are not held.

    ``values`` gives distances (m, BLOCK, BLOCK, BLOCK), metres, of places (m, 3). The places (M, 3)
    are in the table's order; other blocks are as ``inside`` (A, B, C) says. Border voxels and
    those beyond the box become outside.

    Raises:
        StageError: more than VOXEL_LIMIT voxels would be held.
    """
    far = float(np.float32(BAND * voxel))
    table = inside.astype(np.int32)
    constant = np.empty((HELD, BLOCK, BLOCK, BLOCK), np.float32)
    constant[OUTSIDE], constant[INSIDE] = far, -far
    blocks, count = [constant], HELD
    for start in range(0, len(places), CHUNK):
        part = places[start : start + CHUNK]
        found = np.clip(values(part), -far, far).astype(np.float32, copy=False)
        for axis in range(3):
            index = BLOCK * part[:, axis, None] + np.arange(BLOCK)
            last = shape[axis] - 1
            side = np.moveaxis(found, axis + 1, 1)
            for outside, least in (((index == 0) | (index == last), BORDER), (index > last, far)):
                hit = np.nonzero(outside)
                side[hit] = np.maximum(side[hit], np.float32(least))
        near = (found.min((1, 2, 3)) < far) & (found.max((1, 2, 3)) > -far)
        rows = np.where(found[:, 0, 0, 0] < 0, INSIDE, OUTSIDE)
        rows[near] = count + np.arange(near.sum())
        table[tuple(part.T)] = rows
        blocks.append(found[near])
        count += len(blocks[-1])
        if (count - HELD) * BLOCK**3 > VOXEL_LIMIT:
            raise StageError(
                f"the surface needs more than {VOXEL_LIMIT:.2g} voxels of {voxel * 1e3:.3g} mm;"
                " a head needs about 3 million of 1.6 mm. Check that the calibration is in metres;"
                " if it is, raise depth.voxel_mm or depth.voxel_px"
            )
    return LevelSet(origin, voxel, shape, table, np.concatenate(blocks))


def box_shape(extent: np.ndarray, voxel: float) -> tuple[int, int, int]:
    """Count the voxels (X, Y, Z) of a box whose sides are (3,) metres long."""
    x, y, z = np.ceil(extent / voxel - 1e-6).astype(int) + 1
    return int(x), int(y), int(z)


def build(
    low: np.ndarray, high: np.ndarray, voxel: float, distance: Values, steepest: float = STEEPEST
) -> LevelSet:
    """Make the grid of a function of points (N, 3), metres, in the box with corners (3,), (3,).

    Blocks are chosen by the distance at their middles, which changes by at most ``steepest`` metres
    per metre. Where it jumps, neighbouring signs differ without a surface between them: these
    blocks are evaluated too, until none is left.
    """
    shape = box_shape(high - low, voxel)
    size = tuple(-(-n // BLOCK) for n in shape)
    places = np.stack(np.meshgrid(*map(np.arange, size), indexing="ij"), -1).reshape(-1, 3)
    middle = low + voxel * (places * BLOCK + (BLOCK - 1) / 2)
    parts = np.array_split(middle, 1 + len(middle) // 100_000)
    guess = np.concatenate([distance(part) for part in parts]).reshape(size)
    to_corner = 3**0.5 * (BLOCK - 1) / 2
    wanted = np.abs(guess) < (BAND + steepest * to_corner) * voxel
    border = np.ones(size, bool)
    border[1:-1, 1:-1, 1:-1] = False
    wanted |= border & (guess < 0)

    def values(part: np.ndarray) -> np.ndarray:
        index = voxel_index(part)
        return distance(low + voxel * index.reshape(-1, 3)).reshape(index.shape[:-1])

    grid = assemble(low, voxel, shape, guess < 0, np.argwhere(wanted), values)
    while (torn := _torn(grid) & ~wanted).any():
        wanted |= torn

        def grown(part: np.ndarray, old: LevelSet = grid, more: np.ndarray = torn) -> np.ndarray:
            found, new = at(old, part), more[tuple(part.T)]
            if new.any():
                found[new] = values(part[new])
            return found

        grid = replaced(grid, np.argwhere((grid.table >= HELD) | torn), grown)
    return grid


def _torn(grid: LevelSet) -> np.ndarray:
    """Find blocks (A, B, C) with both signs in them or in their neighbours across a face."""
    near = generate_binary_structure(3, 1)
    least = minimum_filter(grid.blocks.min((1, 2, 3))[grid.table], footprint=near)
    most = maximum_filter(grid.blocks.max((1, 2, 3))[grid.table], footprint=near)
    return (least < 0) & (most > 0)


def combined(function: Callable[..., np.ndarray], grid: LevelSet, *others: LevelSet) -> LevelSet:
    """Apply a function to several grids' values wherever any of them holds blocks.

    All have the same box and voxel; elsewhere the first grid's sign stays.
    """
    grids = (grid, *others)
    places = np.argwhere(np.any([g.table >= HELD for g in grids], axis=0))
    return replaced(grid, places, lambda part: function(*(at(g, part) for g in grids)))


def replaced(grid: LevelSet, places: np.ndarray, values: Values) -> LevelSet:
    """Replace the values at places (M, 3), which include all blocks held so far."""
    inside = grid.table == INSIDE
    return assemble(grid.origin, grid.voxel, grid.shape, inside, places, values)


def windows(grid: LevelSet, places: np.ndarray, before: int) -> np.ndarray:
    """Take blocks at places (M, 3) with `before` voxels before and one after: (M, S, S, S)."""
    side = before + BLOCK + 1
    out = np.empty((len(places), side, side, side), grid.blocks.dtype)
    spans = ((-1, slice(BLOCK - before, BLOCK), slice(0, before)),
             (0, slice(0, BLOCK), slice(before, before + BLOCK)),
             (1, slice(0, 1), slice(before + BLOCK, side)))  # fmt: skip
    padded = np.pad(grid.table, 1)  # beyond the box is outside
    for x, y, z in product([span for span in spans if span[1] != slice(BLOCK, BLOCK)], repeat=3):
        rows = padded[tuple((places + [1 + x[0], 1 + y[0], 1 + z[0]]).T)]
        out[:, x[2], y[2], z[2]] = grid.blocks[:, x[1], y[1], z[1]][rows]
    return out


def dilated(grid: LevelSet) -> LevelSet:
    """Hold the blocks around the held ones too; values stay the same."""
    wanted = binary_dilation(grid.table >= HELD, np.ones((3, 3, 3)))
    blocks = np.concatenate([grid.blocks[:HELD], grid.blocks[grid.table[wanted]]])
    table = grid.table.copy()
    table[wanted] = HELD + np.arange(len(blocks) - HELD)
    return replace(grid, table=table, blocks=blocks)


def smoothed(grid: LevelSet, sigma: float, truncate: float = 4.0) -> LevelSet:
    """Convolve with a Gaussian of ``sigma`` voxels, exact in the blocks of ``grid``."""
    radius = int(truncate * sigma + 0.5)
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    return separably(grid, kernel / kernel.sum())


def separably(grid: LevelSet, kernel: np.ndarray) -> LevelSet:
    """Correlate with a kernel (K,) along each axis in turn, exact in ``grid``'s blocks.

    K is odd and at most 2 BLOCK + 1. The result also holds the blocks around, approximately.
    """
    wide = dilated(grid)
    radius = len(kernel) // 2
    matrix = np.zeros((3 * BLOCK, BLOCK), np.float32)
    for k in range(BLOCK):
        matrix[BLOCK + k - radius : BLOCK + k + radius + 1, k] = kernel
    padded, places = np.pad(wide.table, 1), held(wide) + 1
    for axis in range(3):
        out = np.zeros_like(wide.blocks)
        for step, part in zip((-1, 0, 1), np.split(matrix, 3), strict=True):
            rows = padded[tuple((places + step * np.eye(3, dtype=int)[axis]).T)]
            rows = np.concatenate([[OUTSIDE, INSIDE], rows])
            out += np.moveaxis(np.tensordot(wide.blocks[rows], part, (axis + 1, 0)), -1, axis + 1)
        wide = replace(wide, blocks=out)
    return wide


def refined(grid: LevelSet, voxel: float) -> LevelSet:
    """Interpolate the distances on a grid of a smaller voxel, by cubic B-splines (Unser 1999).

    A block of the finer grid is a window of coefficients times one matrix per axis, which depends
    on the block's place along it.
    """
    ratio = voxel / grid.voxel
    shape = box_shape((np.array(grid.shape) - 1) * grid.voxel, voxel)
    axes = []  # of each, the first and the last coarse block that each finer block meets
    for fine, coarse in zip(shape, grid.table.shape, strict=True):
        first = BLOCK * np.arange(-(-fine // BLOCK)) * ratio
        ends = np.floor(first), np.ceil(first + (BLOCK - 1) * ratio)
        axes.append([np.minimum(end.astype(int) >> SHIFT, coarse - 1) for end in ends])
    below = [grid.table[np.ix_(*ends)] for ends in product(*axes)]
    near = np.any([rows >= HELD for rows in below], axis=0) | (np.ptp(below, axis=0) > 0)
    pole = 3**0.5 - 2
    kernel = pole ** np.abs(np.arange(-BLOCK, BLOCK + 1))  # samples to coefficients, cut at BLOCK
    values = _spline_values(separably(grid, kernel / kernel.sum()), ratio)
    return assemble(grid.origin, voxel, shape, below[0] == INSIDE, np.argwhere(near), values)


def _spline_values(spline: LevelSet, ratio: float) -> Values:
    """Evaluate B-spline coefficients at places of finer blocks; ``ratio`` is fine to coarse."""
    side = int((BLOCK - 1) * ratio) + 5
    flat = spline.blocks.reshape(-1)
    last = np.array(spline.table.shape) * BLOCK - 1

    def values(places: np.ndarray) -> np.ndarray:
        weights, rows, inner = [], [], []
        for axis in range(3):
            position = (BLOCK * places[:, axis, None] + np.arange(BLOCK)) * ratio
            first = np.floor(position[:, 0]).astype(int) - 1
            taps = first[:, None] + np.arange(side)
            away = np.abs(position[..., None] - taps[:, None])
            middle = 2 / 3 - away**2 * (1 - away / 2)
            cubic = np.where(away < 1, middle, np.maximum(2 - away, 0) ** 3 / 6)
            weights.append(cubic.astype(np.float32))
            taps = np.clip(taps, 0, last[axis])
            rows.append(taps >> SHIFT)
            inner.append(taps & (BLOCK - 1))
        (x, y, z), (i, j, k) = rows, inner
        found = spline.table[x[:, :, None, None], y[:, None, :, None], z[:, None, None, :]]
        window = flat[
            found.astype(np.int64) * BLOCK**3
            + (i[:, :, None, None] * BLOCK**2 + j[:, None, :, None] * BLOCK + k[:, None, None, :])
        ]
        for weight in weights:  # each product moves the axis it made to the end
            window = np.moveaxis(window, 1, -1) @ weight.transpose(0, 2, 1)[:, None]
        return window

    return values
