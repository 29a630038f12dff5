"""Find the square around a head, and cut images, labels, depth and K to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from express50.errors import StageError
from express50.files.images import resize_area
from express50.geometry.cameras import Camera, crop_camera, project, resized
from express50.geometry.conventions import cell_centres, corner_to_cell

EDGE = 0.01  # neighbours whose depths differ by more than this share lie on two surfaces
MARGIN = 0.1  # room on each side, as a share of the head's size
HAIR = 0.3  # how far the matte may widen the mesh's box, as a share of its size: hair, no shoulders


@dataclass(frozen=True)
class Crop:
    """A square of whole source pixels; its corner (x0, y0) may lie outside the image."""

    x0: int
    y0: int
    side: int


def head_crop(
    camera: Camera,
    vertices: np.ndarray,
    alpha: np.ndarray,
    margin: float = MARGIN,
    hair: float = HAIR,
) -> Crop:
    """Find the crop around a tracked head.

    Args:
        camera: pinhole camera.
        vertices: (V, 3) tracked mesh in the world, metres.
        alpha: (H, W) uint8.
        margin: room on each side, as a share of the head's size.
        hair: how far the matte may widen the mesh's box, as a share of its size.

    Raises:
        StageError: the head is not in the image, or the matte is empty.
    """
    pixels, _ = project(camera, vertices)
    pixels = pixels[np.isfinite(pixels).all(1)]
    if len(pixels) < 0.5 * len(vertices):
        raise StageError("the tracked head lies behind the camera")
    low, high = pixels.min(0), pixels.max(0)
    y, x = np.nonzero(alpha > 127)
    if not len(x):
        raise StageError("its matte is empty")
    reach = hair * (high - low)
    matte = np.array([[x.min(), y.min()], [x.max() + 1, y.max() + 1]], np.float64)
    low = np.minimum(low, np.maximum(low - reach, matte[0]))
    high = np.maximum(high, np.minimum(high + reach, matte[1]))
    if (high <= 0).any() or (low >= (camera.width, camera.height)).any():
        raise StageError("the tracked head lies outside the image")
    low, high = np.maximum(low, 0), np.minimum(high, (camera.width, camera.height))
    side = int(np.ceil((high - low).max() * (1 + 2 * margin)))
    corner = np.floor((low + high) / 2 - side / 2).astype(int)
    return Crop(int(corner[0]), int(corner[1]), side)


def crop_pinhole(camera: Camera, crop: Crop, size: int) -> Camera:
    """Give the camera of the cropped and resized image; exact, as pixels have a corner origin."""
    return resized(crop_camera(camera, crop.x0, crop.y0, crop.side, crop.side), size, size)


def cut_image(image: np.ndarray, crop: Crop, size: int) -> np.ndarray:
    """Cut an image (H, W[, C]) uint8 and resize it to (size, size); 0 outside the image."""
    return resize_area(_window(image, crop), size, size)


def cut_labels(labels: np.ndarray, crop: Crop, size: int) -> np.ndarray:
    """Cut labels (H, W) uint8 to (size, size), each that of the nearest pixel; 0 outside."""
    place = np.minimum((cell_centres(size) * (crop.side / size)).astype(int), crop.side - 1)
    return _window(labels, crop)[np.ix_(place, place)]


def _window(image: np.ndarray, crop: Crop) -> np.ndarray:
    window = np.zeros((crop.side, crop.side, *image.shape[2:]), image.dtype)
    y0, x0 = max(crop.y0, 0), max(crop.x0, 0)
    y1 = min(crop.y0 + crop.side, image.shape[0])
    x1 = min(crop.x0 + crop.side, image.shape[1])
    if y1 > y0 and x1 > x0:
        window[y0 - crop.y0 : y1 - crop.y0, x0 - crop.x0 : x1 - crop.x0] = image[y0:y1, x0:x1]
    return window


def cut_depth(
    depth: np.ndarray, valid: np.ndarray, crop: Crop, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Cut a depth map to (size, size), and its validity; surfaces are never blended.

    Each new pixel's centre takes the bilinear mean of inverse depth, which is exact on planes,
    where its four neighbours are valid and lie on one surface; else its nearest pixel.

    Args:
        depth: (H, W) metres.
        valid: (H, W) bool.
        crop: the square.
        size: side of the result, pixels.
    """
    window, known = _window(depth, crop), _window(valid, crop)
    inverse = np.where(known, 1.0 / np.where(known, window, 1.0), 0.0)
    place = np.clip(corner_to_cell(cell_centres(size) * (crop.side / size)), 0, crop.side - 1)
    low = np.minimum(place.astype(int), max(crop.side - 2, 0))
    high = np.minimum(low + 1, crop.side - 1)
    share = place - low
    near = np.where(share < 0.5, low, high)
    rows, columns = share[:, None], share[None, :]
    corners = [inverse[np.ix_(a, b)] for a in (low, high) for b in (low, high)]
    weights = [a * b for a in (1 - rows, rows) for b in (1 - columns, columns)]
    smallest, largest = np.minimum.reduce(corners), np.maximum.reduce(corners)
    one_surface = (smallest > 0) & (largest <= smallest * (1 + EDGE))
    smooth = sum(w * c for w, c in zip(weights, corners, strict=True))
    chosen = np.where(one_surface, smooth, inverse[np.ix_(near, near)])
    ok = chosen > 0
    return np.where(ok, 1.0 / np.where(ok, chosen, 1.0), 0.0), ok
