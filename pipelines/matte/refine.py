"""Refine an enlarged alpha along the image, tile by tile."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

# Variance of colour (of 1) that counts as flat, so that noise in flat windows is not an edge.
FLAT = 1e-5
ITERATIONS = 30


def smooth_alpha(
    image: np.ndarray,
    alpha: np.ndarray,
    band: np.ndarray,
    weight: float | np.ndarray,
) -> np.ndarray:
    """Smooth alpha (H, W) in `band` (H, W) by an image (H, W, 3) in 8-bit steps; the rest stays.

    Minimises a' L a + weight |a - alpha|^2 over the band by conjugate gradients; the weight, one or
    (H, W), says what alpha is worth.
    """
    if not band.any() or min(band.shape) < 3:
        return alpha
    laplacian = MattingLaplacian(image / 255.0, band)
    count = int(band.sum())
    worth = np.broadcast_to(np.asarray(weight, np.float64), band.shape)[band]

    def product(values: np.ndarray) -> np.ndarray:
        spread = np.zeros(band.shape)
        spread[band] = values
        return laplacian.product(spread)[band] + worth * values

    key = alpha[band].astype(np.float64)
    fixed = np.where(band, 0.0, alpha)
    right = worth * key - laplacian.product(fixed)[band]
    # Preconditioned by its diagonal: windows at image borders and flat ones differ in scale.
    inverse = 1.0 / (laplacian.diagonal()[band] + worth)
    solved, _ = cg(
        LinearOperator((count, count), product, dtype=np.float64),
        right,
        x0=key,
        rtol=1e-2,
        maxiter=ITERATIONS,
        M=LinearOperator((count, count), lambda v: inverse * v, dtype=np.float64),
    )
    out = alpha.copy()
    out[band] = np.clip(solved, 0.0, 1.0)
    return out


class MattingLaplacian:
    """The matting Laplacian of the 3 x 3 windows that touch a band, as an operator on images."""

    def __init__(self, image: np.ndarray, band: np.ndarray) -> None:
        """Prepare for an image (H, W, 3) with colours in [0, 1] and a band (H, W) bool."""
        self.image = np.ascontiguousarray(image, dtype=np.float64)
        windows = cv2.dilate(band.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        # Only windows that lie wholly inside the image.
        windows[[0, -1]] = windows[:, [0, -1]] = False
        self.windows = windows
        mean = _mean(self.image)[windows]  # (M, 3)
        squares = self.image[..., :, None] * self.image[..., None, :]
        products = _mean(squares.reshape(*band.shape, 9))[windows].reshape(-1, 3, 3)
        covariance = products - mean[:, :, None] * mean[:, None, :]
        self.inverse = np.linalg.inv(covariance + FLAT / 9 * np.eye(3))
        self.mean = mean

    def product(self, values: np.ndarray) -> np.ndarray:
        """L @ values, both (H, W); right where the band is."""
        average = _mean(values)[self.windows]
        together = _mean(self.image * values[..., None])[self.windows]
        slope = np.einsum("mij,mj->mi", self.inverse, together - self.mean * average[:, None])
        offset = average - np.einsum("mi,mi->m", slope, self.mean)
        slopes = self._summed(slope)
        rest = self._summed(np.stack([offset, np.ones_like(offset)], axis=1))
        fitted = np.einsum("...i,...i->...", slopes, self.image) + rest[..., 0]
        return rest[..., 1] * values - fitted

    def diagonal(self) -> np.ndarray:
        """Diagonal (H, W) of L; right where the band is."""
        pulled = np.einsum("mij,mj->mi", self.inverse, self.mean)
        constant = np.einsum("mi,mi->m", pulled, self.mean)
        inverse = self._summed(self.inverse.reshape(-1, 9)).reshape(*self.windows.shape, 3, 3)
        rest = self._summed(np.column_stack([pulled, constant, np.ones_like(constant)]))
        form = np.einsum("...i,...ij,...j->...", self.image, inverse, self.image)
        form -= 2 * np.einsum("...i,...i->...", self.image, rest[..., :3])
        return rest[..., 4] - (rest[..., 4] + form + rest[..., 3]) / 9

    def _summed(self, values: np.ndarray) -> np.ndarray:
        """Sum (H, W, C) over the windows that hold each pixel of values (M, C), one a window."""
        spread = np.zeros((*self.windows.shape, values.shape[1]))
        spread[self.windows] = values
        return _box(spread, normalize=False)


def _mean(image: np.ndarray) -> np.ndarray:
    return _box(image, normalize=True)


def _box(image: np.ndarray, normalize: bool) -> np.ndarray:
    return cv2.boxFilter(
        image, cv2.CV_64F, (3, 3), normalize=normalize, borderType=cv2.BORDER_CONSTANT
    )


STEP = 64  # tiles start on multiples of this: networks that halve the picture stay in phase


def in_tiles(
    shape: tuple[int, int],
    tile: int,
    overlap: int,
    compute: Callable[[slice, slice], np.ndarray],
) -> np.ndarray:
    """Call ``compute(rows, columns)`` for tiles of an image, and join them to (H, W) float32.

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
    """Give slices that cover a length; neighbours share ``overlap``.

    Raises:
        ValueError: ``tile`` or ``overlap`` is not a multiple of STEP, or the overlap not smaller.
    """
    if tile % STEP or overlap % STEP or not 0 < overlap < tile:
        raise ValueError(f"tile {tile}, overlap {overlap}: expected multiples of {STEP}, tile more")
    starts = [0]
    while starts[-1] + tile < length:
        starts.append(starts[-1] + tile - overlap)
    return [slice(start, min(start + tile, length)) for start in starts]


def _join(whole: np.ndarray, piece: np.ndarray, start: int, end: int) -> None:
    """Put a piece into the columns from ``start``; those before ``end`` exist and fade."""
    shared = end - start
    if shared > 0:
        place = np.arange(shared) + 0.5
        share = np.clip((place - shared / 4) / (shared / 2), 0, 1).astype(np.float32)
        old = whole[:, start:end]
        new = piece[:, :shared]
        old[:] = np.where(share < 1, old + share * (new - old), new)
        piece, start = piece[:, shared:], end
    whole[:, start : start + piece.shape[1]] = piece
