"""Find the square around a head, and cut images, labels, depth and K to it.

A soft pixel of the footage holds light of the plate, which would be a rim before another
background. Where the plate is known, `own_colours` solves for the likeliest colour of the subject
(Chuang et al. 2001 with alpha and plate given); elsewhere it takes the subject's colours nearby.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from express50.errors import StageError
from express50.files.images import linear_to_srgb, resize_area
from express50.geometry.cameras import Camera, crop_camera, project, resized
from express50.geometry.conventions import cell_centres, corner_to_cell
from pipelines.matte.plates import (
    LEAST_SHARE,
    exposed,
    exposure_gain,
    local_colours,
    match_plate,
    to_light,
)

EDGE = 0.01  # neighbours whose depths differ by more than this share lie on two surfaces
MARGIN = 0.1  # room on each side, as a share of the head's size
HAIR = 0.3  # how far the matte may widen the mesh's box, as a share of its size: hair, no shoulders
REACH_SHARE = 0.008  # of the image's longer side: largest distance from which colours are taken
SPREAD = 0.25  # share by which a strand may be brighter or darker than its neighbours
NOISE = 0.01  # deviation of linear light by sensor, compression and errors of alpha
SOLID = 0.98  # alpha from which a pixel has the subject's colour alone


@dataclass(frozen=True)
class Crop:
    """A square aligned to source pixels; its corner (x0, y0) may lie outside the image."""

    x0: int
    y0: int
    side: int


def head_crop(camera: Camera, vertices: np.ndarray, alpha: np.ndarray) -> Crop:
    """Find the crop around a tracked head: vertices (V, 3), metres, alpha (H, W) uint8, a pinhole.

    Raises:
        StageError: the head is not in the image, or the matte is empty.
    """
    pixels, _ = project(camera, vertices)
    pixels = pixels[np.isfinite(pixels).all(1)]
    if len(pixels) < 0.5 * len(vertices):
        raise StageError("the tracked head lies behind the camera")
    low, high = pixels.min(0), pixels.max(0)
    x, y, width, height = cv2.boundingRect((alpha > 127).astype(np.uint8))
    if not width:
        raise StageError("its matte is empty")
    reach = HAIR * (high - low)
    matte = np.array([[x, y], [x + width, y + height]], np.float64)
    low = np.minimum(low, np.maximum(low - reach, matte[0]))
    high = np.maximum(high, np.minimum(high + reach, matte[1]))
    if (high <= 0).any() or (low >= (camera.width, camera.height)).any():
        raise StageError("the tracked head lies outside the image")
    low, high = np.maximum(low, 0), np.minimum(high, (camera.width, camera.height))
    side = int(np.ceil((high - low).max() * (1 + 2 * MARGIN)))
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
    """Cut depth (H, W), metres, and its validity to (size, size); surfaces are never blended.

    Each new pixel's centre takes the bilinear mean of inverse depth, which is exact on planes,
    where its four neighbours are valid and lie on one surface; else its nearest pixel.
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


def cut_own_colours(
    frame: np.ndarray, matte: np.ndarray, plate: np.ndarray | None, crop: Crop, size: int
) -> np.ndarray:
    """Cut a frame to (size, size, 3) with the subject's own colour in soft pixels.

    Frame and clean plate, or None, are (H, W, 3) uint8 sRGB; the matte (H, W) uint8 is of
    everything in front of the plate, torso included. As in `matte`, the plate is matched to the
    frame first, and not used if it shows another set.
    """
    behind = None
    if plate is not None:
        found = match_plate(plate, frame, matte == 0)
        if found.share >= LEAST_SHARE:
            gain = exposure_gain(frame, found.plate)
            behind = exposed(cut_image(found.plate, crop, size), gain)
    return own_colours(cut_image(frame, crop, size), cut_image(matte, crop, size), behind)


def own_colours(image: np.ndarray, alpha: np.ndarray, plate: np.ndarray | None) -> np.ndarray:
    """Replace the colours of an image (H, W, 3) uint8 sRGB where 0 < alpha < 1, of (H, W) uint8.

    The plate is the background in the frame's exposure, (H, W, 3) in 8-bit steps, or None.

    Raises:
        ValueError: sizes differ.
    """
    if alpha.shape != image.shape[:2] or (plate is not None and plate.shape != image.shape):
        raise ValueError(
            f"image {image.shape}, alpha {alpha.shape} and plate "
            f"{None if plate is None else plate.shape} differ in size"
        )
    opacity = alpha.astype(np.float32) / 255
    soft = (alpha > 0) & (alpha < 255)
    solid = (opacity >= SOLID).astype(np.float32)
    if not soft.any() or not solid.any():
        return image
    light = to_light(image)
    reach = max(1.0, REACH_SHARE * max(image.shape[:2]))
    mean, covariance = local_colours(light, solid, soft, reach, SPREAD)
    share = opacity[soft].astype(np.float64)[:, None]
    if plate is None:
        # Mostly subject: the pixel itself is as good a guess as its neighbours.
        colour = mean + share**4 * (light[soft] - mean)
    else:
        behind = to_light(plate)[soft]
        rest = light[soft] - (1 - share) * behind - share * mean
        square = share[..., None] ** 2
        gain = np.linalg.solve(square * covariance + NOISE**2 * np.eye(3), rest[..., None])
        colour = mean + share * (covariance @ gain)[..., 0]
    out = image.copy()
    out[soft] = np.rint(255 * linear_to_srgb(np.clip(colour, 0, 1)))
    return out
