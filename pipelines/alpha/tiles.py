"""A picture in tiles that overlap, so that memory does not grow with it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

STEP = 64  # tiles start on multiples of this: networks that halve the picture stay in phase


def in_tiles(
    shape: tuple[int, int],
    tile: int,
    overlap: int,
    compute: Callable[[slice, slice], np.ndarray],
) -> np.ndarray:
    """What ``compute(rows, columns)`` gives for tiles of an image, joined to (H, W) float32.

    In an overlap the outer quarter of each tile, whose surroundings it did not see, is not used,
    and the half between fades from one tile to the other; where the two agree the result is
    exactly theirs.

    Args:
        shape: (H, W) of the image.
        tile: longest side of a tile, pixels; a multiple of STEP.
        overlap: pixels that neighbours share; a multiple of STEP, less than ``tile``.
        compute: gives (rows, columns) values of one tile.
    """
    whole = np.zeros(shape, np.float32)
    row_end = 0
    for rows in spans(shape[0], tile, overlap):
        strip = np.zeros((rows.stop - rows.start, shape[1]), np.float32)
        end = 0
        for columns in spans(shape[1], tile, overlap):
            _join(strip, compute(rows, columns), columns.start, end)
            end = columns.stop
        _join(whole.T, strip.T, rows.start, row_end)
        row_end = rows.stop
    return whole


def spans(length: int, tile: int, overlap: int) -> list[slice]:
    """Slices that cover a length; neighbours share ``overlap``.

    Raises:
        ValueError: ``tile`` or ``overlap`` is no multiple of STEP, or the overlap not the smaller.
    """
    if tile % STEP or overlap % STEP or not 0 < overlap < tile:
        raise ValueError(f"tile {tile}, overlap {overlap}: expected multiples of {STEP}, tile more")
    starts = [0]
    while starts[-1] + tile < length:
        starts.append(starts[-1] + tile - overlap)
    return [slice(start, min(start + tile, length)) for start in starts]


def _join(whole: np.ndarray, piece: np.ndarray, start: int, end: int) -> None:
    """Put a piece into the columns from ``start``; those before ``end`` are there and fade."""
    shared = end - start
    if shared > 0:
        place = np.arange(shared) + 0.5
        share = np.clip((place - shared / 4) / (shared / 2), 0, 1).astype(np.float32)
        old = whole[:, start:end]
        new = piece[:, :shared]
        old[:] = np.where(share < 1, old + share * (new - old), new)
        piece, start = piece[:, shared:], end
    whole[:, start : start + piece.shape[1]] = piece
