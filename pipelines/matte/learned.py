"""Run the user's matting network.

- ``bgmv2``: BackgroundMattingV2 (Lin et al. 2021) sees frame and clean plate, ``src`` and ``bgr``,
  RGB in [0, 1], sides multiples of 4; it gives ``pha`` first (its ``doc/model_usage.md``).
- ``salient``: RMBG-2.0 and BiRefNet (Zheng et al. 2024) see the frame alone, squeezed to their own
  square, less ImageNet's mean and over its deviation; RMBG-2.0's ONNX file takes ``pixel_values``
  and gives ``alphas``; others end before the sigmoid, which the range of their values shows.
"""

from __future__ import annotations

import cv2
import numpy as np

from pipelines.matte.refine import in_tiles, smooth_alpha
from pipelines.networks import Network, Role, resized

BGMV2 = Role(setting="matte.weights", inputs=("src", "bgr"), outputs=("pha",))
SALIENT = Role(
    setting="matte.weights", inputs=("pixel_values",), outputs=("alphas", "output_image"), place=-1
)
MULTIPLE = 4  # BackgroundMattingV2 refines patches of 4 x 4 pixels
LEAST_SIDE = 64  # below this its encoder has nothing left to see
OVERLAP = 256  # pixels; half of it is context that a tile sees and does not write
SIDE = 1024  # of the salient networks, where the file does not say
MEAN = np.array([0.485, 0.456, 0.406], np.float32)  # ImageNet's
DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)
# Weight of the enlarged alpha against smoothness along colours: small, as it knows no detail.
ENLARGED_WEIGHT = 0.01
REFINE_TILE, REFINE_OVERLAP = 1024, 64


def background_alpha(
    network: Network, frame: np.ndarray, plate: np.ndarray, tile: int, overlap: int = OVERLAP
) -> np.ndarray:
    """Opacity (H, W) float32 of a frame (H, W, 3), its plate (H, W, 3) known, 8-bit steps both.

    Frames beyond `tile` pixels are cut up. The network pools over all it sees, so tiles differ a
    little from a whole; where memory allows, let `tile` hold the frame.

    Raises:
        StageError: the network failed, or gave another size or numbers that are not finite.
    """

    def compute(rows: slice, columns: slice) -> np.ndarray:
        pair = [_padded(x[rows, columns].astype(np.float32) / 255) for x in (frame, plate)]
        answer = network(*pair)
        if answer.shape != (1, *pair[0].shape[:2]):
            raise _wrong_shape(network, answer, (1, *pair[0].shape[:2]))
        return answer[0, : rows.stop - rows.start, : columns.stop - columns.start]

    alpha = in_tiles(frame.shape[:2], tile, overlap, compute)
    return np.clip(alpha, 0, 1)


def salient_alpha(network: Network, frame: np.ndarray) -> np.ndarray:
    """Opacity (H, W) float32 of what stands out in a frame (H, W, 3) uint8.

    The network sees the frame at its own size; where that is smaller, the enlarged alpha follows
    the frame's colours in the uncertain band.

    Raises:
        StageError: the network failed, or gave another size or numbers that are not finite.
    """
    height, width = network.size or (SIDE, SIDE)
    small = resized(frame, height, width).astype(np.float32)
    answer = network((small / 255 - MEAN) / DEVIATION)
    if answer.shape != (1, height, width):
        raise _wrong_shape(network, answer, (1, height, width))
    alpha = as_opacity(answer[0])
    if (height, width) == frame.shape[:2]:
        return alpha
    alpha = np.clip(resized(alpha, *frame.shape[:2]), 0, 1)
    return refined(frame, alpha, max(frame.shape[0] / height, frame.shape[1] / width))


def as_opacity(values: np.ndarray) -> np.ndarray:
    """Opacities of values that may be logits: those leave [0, 1], what a sigmoid gave does not."""
    if values.min() >= -1e-3 and values.max() <= 1 + 1e-3:
        return np.clip(values, 0, 1)
    return (1 / (1 + np.exp(-np.clip(values, -60, 60)))).astype(np.float32)


def refined(frame: np.ndarray, alpha: np.ndarray, factor: float) -> np.ndarray:
    """Alpha (H, W) that was enlarged by a factor, along the colours of a frame (H, W, 3) uint8."""
    if factor <= 1:
        return alpha
    unsure = ((alpha > 0.01) & (alpha < 0.99)).astype(np.uint8)
    side = 2 * round(factor) + 1
    band = cv2.dilate(unsure, np.ones((side, side), np.uint8)) > 0

    def compute(rows: slice, columns: slice) -> np.ndarray:
        part = np.s_[rows, columns]
        return smooth_alpha(frame[part], alpha[part], band[part], ENLARGED_WEIGHT)

    return in_tiles(alpha.shape, REFINE_TILE, REFINE_OVERLAP, compute)


def _padded(image: np.ndarray) -> np.ndarray:
    """The image (H, W, 3) with its last row and column repeated up to a size the network takes."""
    height, width = (max(LEAST_SIDE, n + -n % MULTIPLE) for n in image.shape[:2])
    down, right = height - image.shape[0], width - image.shape[1]
    return cv2.copyMakeBorder(image, 0, down, 0, right, cv2.BORDER_REPLICATE)


def _wrong_shape(network: Network, answer: np.ndarray, expected: tuple[int, ...]) -> Exception:
    return network.error(
        f"gave shape {answer.shape}, expected {expected}; does matte.method fit the file?"
    )
