"""Run the user's matting network.

- ``bgmv2``: BackgroundMattingV2 (Lin et al. 2021) takes frame and clean plate, ``src`` and ``bgr``,
  RGB in [0, 1], sides multiples of 4; its first output is ``pha`` (its ``doc/model_usage.md``).
- ``salient``: RMBG-2.0 and BiRefNet (Zheng et al. 2024) take the frame alone, resized to their own
  square and normalised with ImageNet's mean and deviation. RMBG-2.0's ONNX file takes
  ``pixel_values`` and gives ``alphas``; files that end before the sigmoid give logits.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

from express50.geometry.conventions import cell_centres
from express50.geometry.pixels import resize_area
from pipelines.networks import Network, Role

BGMV2 = Role(setting="matte.weights", inputs=("src", "bgr"), outputs=("pha",))
SALIENT = Role(
    setting="matte.weights", inputs=("pixel_values",), outputs=("alphas", "output_image"), place=-1
)
MULTIPLE = 4  # BackgroundMattingV2 refines patches of 4 x 4 pixels
LEAST_SIDE = 64  # smaller inputs leave its encoder no pixels
OVERLAP = 256  # pixels; half of it is context that a tile sees but does not write
SIDE = 1024  # of a salient network's input, if the file does not say
MEAN = np.array([0.485, 0.456, 0.406], np.float32)  # ImageNet's
DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)
# Weight of the enlarged alpha against smoothness along colours; small, because it has no detail.
ENLARGED_WEIGHT = 0.01
REFINE_TILE, REFINE_OVERLAP = 1024, 64
FLAT = 1e-5  # variance of colour (of 1) that counts as flat, so that noise is not an edge
ITERATIONS = 30


def background_alpha(
    network: Network, frame: np.ndarray, plate: np.ndarray, tile: int
) -> np.ndarray:
    """Return opacity (H, W) float32 of a frame and its plate (H, W, 3), both in 8-bit steps.

    Frames over `tile` pixels are tiled. The network pools over its whole input, so tiles give a
    slightly different alpha; if memory allows, make `tile` as large as the frame.

    Raises:
        StageError: the network failed, or its answer has another size or is not finite.
    """

    def compute(rows: slice, columns: slice) -> np.ndarray:
        height, width = rows.stop - rows.start, columns.stop - columns.start
        # The network takes certain sizes only: the last row and column are repeated.
        down, right = (max(LEAST_SIDE, n + -n % MULTIPLE) - n for n in (height, width))
        pair = (x[rows, columns].astype(np.float32) / 255 for x in (frame, plate))
        edge = 0, down, 0, right, cv2.BORDER_REPLICATE
        answer = network(*(cv2.copyMakeBorder(image, *edge) for image in pair))
        _check_shape(network, answer, (height + down, width + right))
        return answer[0, :height, :width]

    return np.clip(in_tiles(frame.shape[:2], tile, OVERLAP, compute), 0, 1)


def salient_alpha(network: Network, frame: np.ndarray) -> np.ndarray:
    """Return the opacity (H, W) float32 of the salient subject in a frame (H, W, 3) uint8.

    The network sees the frame at its own size. If that is smaller, alpha is enlarged, and follows
    the frame's colours where it is uncertain.

    Raises:
        StageError: the network failed, or its answer has another size or is not finite.
    """
    height, width = network.size or (SIDE, SIDE)
    small = resize_area(frame, width, height).astype(np.float32)
    answer = network((small / 255 - MEAN) / DEVIATION)
    _check_shape(network, answer, (height, width))
    alpha = as_opacity(answer[0])
    if (height, width) == frame.shape[:2]:
        return alpha
    alpha = np.clip(resize_area(alpha, frame.shape[1], frame.shape[0]), 0, 1)
    return refined(frame, alpha, max(frame.shape[0] / height, frame.shape[1] / width))


def as_opacity(values: np.ndarray) -> np.ndarray:
    """Return the opacities of values that are logits if some of them lie outside [0, 1]."""
    if values.min() >= -1e-3 and values.max() <= 1 + 1e-3:
        return np.clip(values, 0, 1)
    return (1 / (1 + np.exp(-np.clip(values, -60, 60)))).astype(np.float32)


def refined(frame: np.ndarray, alpha: np.ndarray, factor: float) -> np.ndarray:
    """Refine an enlarged alpha (H, W) along the colours of a frame (H, W, 3) uint8."""
    if factor <= 1:
        return alpha
    unsure = ((alpha > 0.01) & (alpha < 0.99)).astype(np.uint8)
    side = 2 * round(factor) + 1
    band = cv2.dilate(unsure, np.ones((side, side), np.uint8)) > 0

    def compute(rows: slice, columns: slice) -> np.ndarray:
        part = np.s_[rows, columns]
        return smooth_alpha(frame[part], alpha[part], band[part])

    return in_tiles(alpha.shape, REFINE_TILE, REFINE_OVERLAP, compute)


def _check_shape(network: Network, answer: np.ndarray, size: tuple[int, ...]) -> None:
    """Raise StageError unless an answer is one channel of this size (height, width)."""
    if answer.shape != (1, *size):
        raise network.error(
            f"gave shape {answer.shape}, expected {(1, *size)}; does matte.method fit the file?"
        )


def smooth_alpha(image: np.ndarray, alpha: np.ndarray, band: np.ndarray) -> np.ndarray:
    """Smooth alpha (H, W) in `band` (H, W) along the colours of an image (H, W, 3), 8-bit steps.

    Minimises a' L a + ENLARGED_WEIGHT |a - alpha|^2 over the band by conjugate gradients.
    """
    if not band.any() or min(band.shape) < 3:
        return alpha
    laplacian = MattingLaplacian(image / 255.0, band)
    count = int(band.sum())

    def product(values: np.ndarray) -> np.ndarray:
        spread = np.zeros(band.shape)
        spread[band] = values
        return laplacian.product(spread)[band] + ENLARGED_WEIGHT * values

    key = alpha[band].astype(np.float64)
    fixed = np.where(band, 0.0, alpha)
    right = ENLARGED_WEIGHT * key - laplacian.product(fixed)[band]
    # Preconditioned by the diagonal: flat windows and those at image borders differ in scale.
    inverse = 1.0 / (laplacian.diagonal()[band] + ENLARGED_WEIGHT)
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
        """Prepare the windows of an image (H, W, 3), colours in [0, 1], and a band (H, W) bool."""
        self.image = np.ascontiguousarray(image, dtype=np.float64)
        windows = cv2.dilate(band.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        # Windows must lie inside the image.
        windows[[0, -1]] = windows[:, [0, -1]] = False
        self.windows = windows
        mean = _window_mean(self.image)[windows]  # (M, 3)
        squares = self.image[..., :, None] * self.image[..., None, :]
        products = _window_mean(squares.reshape(*band.shape, 9))[windows].reshape(-1, 3, 3)
        covariance = products - mean[:, :, None] * mean[:, None, :]
        self.inverse = np.linalg.inv(covariance + FLAT / 9 * np.eye(3))
        self.mean = mean

    def product(self, values: np.ndarray) -> np.ndarray:
        """Return L @ values, both (H, W); valid in the band only."""
        average = _window_mean(values)[self.windows]
        together = _window_mean(self.image * values[..., None])[self.windows]
        slope = np.einsum("mij,mj->mi", self.inverse, together - self.mean * average[:, None])
        offset = average - np.einsum("mi,mi->m", slope, self.mean)
        slopes = self._summed(slope)
        rest = self._summed(np.stack([offset, np.ones_like(offset)], axis=1))
        fitted = np.einsum("...i,...i->...", slopes, self.image) + rest[..., 0]
        return rest[..., 1] * values - fitted

    def diagonal(self) -> np.ndarray:
        """Return the diagonal (H, W) of L; valid in the band only."""
        pulled = np.einsum("mij,mj->mi", self.inverse, self.mean)
        constant = np.einsum("mi,mi->m", pulled, self.mean)
        inverse = self._summed(self.inverse.reshape(-1, 9)).reshape(*self.windows.shape, 3, 3)
        rest = self._summed(np.column_stack([pulled, constant, np.ones_like(constant)]))
        form = np.einsum("...i,...ij,...j->...", self.image, inverse, self.image)
        form -= 2 * np.einsum("...i,...i->...", self.image, rest[..., :3])
        return rest[..., 4] - (rest[..., 4] + form + rest[..., 3]) / 9

    def _summed(self, values: np.ndarray) -> np.ndarray:
        """Return per pixel the sum (H, W, C) of the values (M, C) of windows that contain it."""
        spread = np.zeros((*self.windows.shape, values.shape[1]))
        spread[self.windows] = values
        return _window_mean(spread, normalize=False)


def _window_mean(image: np.ndarray, normalize: bool = True) -> np.ndarray:
    return cv2.boxFilter(
        image, cv2.CV_64F, (3, 3), normalize=normalize, borderType=cv2.BORDER_CONSTANT
    )


def in_tiles(
    shape: tuple[int, int], tile: int, overlap: int, compute: Callable[[slice, slice], np.ndarray]
) -> np.ndarray:
    """Call ``compute(rows, columns)`` for tiles of an image, and join the results (H, W) float32.

    The outer quarter of each tile's overlap is not used, because the tile does not see what
    surrounds it. In the half between, one tile fades into the other; where they agree, the result
    is exactly theirs. The longest side of a tile and the overlap are multiples of 64 pixels, so
    that networks that halve the picture several times sample all tiles alike.
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
    """Return slices of at most ``tile`` that cover a length; neighbours share ``overlap``."""
    starts = [0]
    while starts[-1] + tile < length:
        starts.append(starts[-1] + tile - overlap)
    return [slice(start, min(start + tile, length)) for start in starts]


def _join(whole: np.ndarray, piece: np.ndarray, start: int, end: int) -> None:
    """Write a piece into the columns from ``start``; it fades in over those before ``end``."""
    shared = end - start
    if shared > 0:
        share = np.clip((cell_centres(shared) - shared / 4) / (shared / 2), 0, 1)
        share = share.astype(np.float32)
        old = whole[:, start:end]
        new = piece[:, :shared]
        old[:] = np.where(share < 1, old + share * (new - old), new)
        piece, start = piece[:, shared:], end
    whole[:, start : start + piece.shape[1]] = piece
