"""Head crops: the part of each picture where the head is, and sampling it at places on the skin."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from express50.files.images import LIGHT_OF_LEVEL, resize_area
from express50.geometry.cameras import Camera, crop_camera, resized
from express50.geometry.pinhole import inside_frame, project_pinhole
from express50.geometry.sampling import bilinear_slope
from pipelines.track.outline import SignedDistance

MARGIN = 0.15


@dataclass(frozen=True)
class HeadCrop:
    """One camera's picture of a frame set, cropped to the head.

    Attributes:
        camera_id: camera id.
        camera: pinhole camera of the crop.
        image: (H, W, 3) uint8 sRGB.
        alpha: (H, W) uint8, 255 where the subject is; None without a matte.
    """

    camera_id: str
    camera: Camera
    image: np.ndarray
    alpha: np.ndarray | None


@dataclass(frozen=True)
class FrameSetCrops:
    """The pictures of one frame set: distances to its mattes' outlines, and head crops."""

    distances: tuple[SignedDistance, ...]
    crops: tuple[HeadCrop, ...]


def cut_crop(
    camera: Camera, image: np.ndarray, alpha: np.ndarray | None, mesh: np.ndarray, side: int
) -> HeadCrop | None:
    """Crop an undistorted frame (H, W, 3) to a mesh (V, 3) and shrink it to at most `side` pixels.

    Returns None where the head is behind the camera or (almost) outside the frame.
    """
    pixels, depth = project_pinhole(camera, mesh)
    if (depth <= 1e-3).any():
        return None
    low, high = pixels.min(0), pixels.max(0)
    grow = MARGIN * (high - low).max()
    x0, y0 = np.maximum(np.floor(low - grow), 0).astype(int).tolist()
    x1, y1 = np.minimum(np.ceil(high + grow), (camera.width, camera.height)).astype(int).tolist()
    if min(x1 - x0, y1 - y0) < 8:
        return None
    seen = crop_camera(camera, x0, y0, x1 - x0, y1 - y0)
    image = np.ascontiguousarray(image[y0:y1, x0:x1])
    alpha = None if alpha is None else np.ascontiguousarray(alpha[y0:y1, x0:x1])
    step = max(seen.width, seen.height) / side
    if step > 1.0:
        width, height = max(8, round(seen.width / step)), max(8, round(seen.height / step))
        seen = resized(seen, width, height)
        image = resize_area(image, width, height)
        alpha = None if alpha is None else resize_area(alpha, width, height)
    return HeadCrop(camera.id, seen, image, alpha)


def root_light(crop: HeadCrop) -> tuple[np.ndarray, Camera]:
    """Return the square root of linear light (h, w, 3) float32, and its camera.

    In the root of light a surface's colour, the light on it and a camera's gain still multiply,
    and shot noise is the same everywhere (Anscombe 1948).
    """
    return np.sqrt(cv2.GaussianBlur(LIGHT_OF_LEVEL[crop.image], (0, 0), 0.7)), crop.camera


def matte_weights(crop: HeadCrop, places: np.ndarray) -> np.ndarray:
    """Weigh places (S, 3) by the matte (S,): 0 outside the picture or the subject, at most 1."""
    pixels, inside = inside_frame(crop.camera, places)
    if crop.alpha is None:
        return inside.astype(np.float64)
    size = np.array([crop.camera.width, crop.camera.height])
    column, row = np.clip(pixels.astype(np.int64), 0, size - 1).T
    return inside * (crop.alpha[row, column] / 255.0)


def look_up(camera: Camera, image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Interpolate a picture (H, W, C) at world points (S, 3): values (S, C)."""
    return bilinear_slope(image, project_pinhole(camera, places)[0])[0]
