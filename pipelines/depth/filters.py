"""Filters over the blocks of a grid, and the grid of a finer voxel."""

from __future__ import annotations

from itertools import product

import numpy as np

from pipelines.depth.blocks import (
    BLOCK,
    HELD,
    INSIDE,
    OUTSIDE,
    SHIFT,
    Grid,
    Values,
    assemble,
    box_shape,
    dilated,
    held,
)


def smoothed(grid: Grid, sigma: float, truncate: float = 4.0) -> Grid:
    """Values convolved with a Gaussian of ``sigma`` voxels, exact in the blocks of ``grid``.

    Passes along the axes need the blocks around, of which the result holds guesses.
    """
    radius = int(truncate * sigma + 0.5)
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    return separably(grid, kernel / kernel.sum())


def separably(grid: Grid, kernel: np.ndarray) -> Grid:
    """Values correlated with a kernel (K,) along each axis in turn, exact in ``grid``'s blocks."""
    wide = dilated(grid)
    for axis in range(3):
        wide = _correlated(wide, kernel, axis)
    return wide


def _correlated(grid: Grid, kernel: np.ndarray, axis: int) -> Grid:
    """Blocks held correlated with a kernel (K,) along an axis, K odd and at most 2 BLOCK + 1.

    A block and its two neighbours make lines of 3 BLOCK voxels: their products with one matrix.
    """
    radius = len(kernel) // 2
    matrix = np.zeros((3 * BLOCK, BLOCK), np.float32)
    for k in range(BLOCK):
        matrix[BLOCK + k - radius : BLOCK + k + radius + 1, k] = kernel
    padded, places = np.pad(grid.table, 1), held(grid) + 1
    out = np.zeros_like(grid.blocks)
    for step, part in zip((-1, 0, 1), np.split(matrix, 3), strict=True):
        rows = padded[tuple((places + step * np.eye(3, dtype=int)[axis]).T)]
        rows = np.concatenate([[OUTSIDE, INSIDE], rows])
        out += np.moveaxis(np.tensordot(grid.blocks[rows], part, (axis + 1, 0)), -1, axis + 1)
    return Grid(grid.origin, grid.voxel, grid.shape, grid.table, out)


def refined(grid: Grid, voxel: float) -> Grid:
    """The same distances on a grid of a smaller voxel: cubic B-splines through them.

    A block of the finer grid takes a window of coefficients, and along each axis a matrix that
    depends on the block's place along it.
    """
    ratio = voxel / grid.voxel
    shape = box_shape((np.array(grid.shape) - 1) * grid.voxel, voxel)
    axes = [_coarse_span(-(-n // BLOCK), ratio, m)
            for n, m in zip(shape, grid.table.shape, strict=True)]  # fmt: skip
    below = [grid.table[np.ix_(*ends)] for ends in product(*axes)]
    near = np.any([rows >= HELD for rows in below], axis=0) | (np.ptp(below, axis=0) > 0)
    spline = separably(grid, _spline_kernel())
    values = _spline_values(spline, ratio)
    return assemble(grid.origin, voxel, shape, below[0] == INSIDE, np.argwhere(near), values)


def _coarse_span(count: int, ratio: float, coarse: int) -> tuple[np.ndarray, np.ndarray]:
    """First and last coarse block (count,), (count,) that each finer block along an axis meets."""
    first = BLOCK * np.arange(count) * ratio
    ends = [np.floor(first).astype(int), np.ceil(first + (BLOCK - 1) * ratio).astype(int)]
    low, high = (np.minimum(end >> SHIFT, coarse - 1) for end in ends)
    return low, high


def _spline_kernel() -> np.ndarray:
    """Samples to the coefficients of the cubic B-spline through them (Unser 1999), cut at BLOCK."""
    pole = 3**0.5 - 2
    kernel = pole ** np.abs(np.arange(-BLOCK, BLOCK + 1))
    return kernel / kernel.sum()


def _spline_values(spline: Grid, ratio: float) -> Values:
    """Values of finer blocks' places from B-spline coefficients; ``ratio`` is fine to coarse."""
    side = int((BLOCK - 1) * ratio) + 5
    flat = spline.blocks.reshape(-1)
    last = np.array(spline.table.shape) * BLOCK - 1

    def values(places: np.ndarray) -> np.ndarray:
        weights, rows, inner = [], [], []
        for axis in range(3):
            position = (BLOCK * places[:, axis, None] + np.arange(BLOCK)) * ratio
            first = np.floor(position[:, 0]).astype(int) - 1
            taps = first[:, None] + np.arange(side)
            weights.append(_cubic(position[..., None] - taps[:, None]).astype(np.float32))
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


def _cubic(offset: np.ndarray) -> np.ndarray:
    """The cubic B-spline at offsets from its middle."""
    away = np.abs(offset)
    inner = 2 / 3 - away**2 * (1 - away / 2)
    return np.where(away < 1, inner, np.maximum(2 - away, 0) ** 3 / 6)
