"""The part of each frame where the head is, small enough to keep, in light that errs evenly."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from express50.files.images import LIGHT_OF_LEVEL, resize_area
from express50.geometry.cameras import Camera, crop_camera, resized
from pipelines.track.pinhole import project_pinhole

MARGIN = 0.15


@dataclass(frozen=True)
class Shot:
    """One camera's picture of one moment, cropped to the head.

    Attributes:
        camera_id: camera's name.
        camera: pinhole camera of the crop.
        image: (H, W, 3) uint8 sRGB.
        alpha: (H, W) uint8, 255 where the subject is; None without a matte.
    """

    camera_id: str
    camera: Camera
    image: np.ndarray
    alpha: np.ndarray | None


def cut_shot(
    camera: Camera, image: np.ndarray, alpha: np.ndarray | None, mesh: np.ndarray, side: int
) -> Shot | None:
    """Crop an undistorted frame (H, W, 3) to a mesh (V, 3) and shrink it to at most `side` pixels.

    Returns None where the head is behind the camera or (almost) outside the frame.
    """
    window = _window(camera, mesh)
    if window is None:
        return None
    x0, y0, x1, y1 = window
    seen = crop_camera(camera, x0, y0, x1 - x0, y1 - y0)
    image = np.ascontiguousarray(image[y0:y1, x0:x1])
    alpha = None if alpha is None else np.ascontiguousarray(alpha[y0:y1, x0:x1])
    step = max(seen.width, seen.height) / side
    if step > 1.0:
        width, height = max(8, round(seen.width / step)), max(8, round(seen.height / step))
        seen = resized(seen, width, height)
        image = resize_area(image, width, height)
        alpha = None if alpha is None else resize_area(alpha, width, height)
    return Shot(camera.id, seen, image, alpha)


def _window(camera: Camera, mesh: np.ndarray) -> tuple[int, int, int, int] | None:
    """Pixel window x0, y0, x1, y1 about the mesh; None where there is next to nothing to see."""
    pixels, depth = project_pinhole(camera, mesh)
    if (depth <= 1e-3).any():
        return None
    low, high = pixels.min(0), pixels.max(0)
    grow = MARGIN * (high - low).max()
    x0, y0 = np.maximum(np.floor(low - grow), 0).astype(int)
    x1, y1 = np.minimum(np.ceil(high + grow), (camera.width, camera.height)).astype(int)
    return (int(x0), int(y0), int(x1), int(y1)) if min(x1 - x0, y1 - y0) >= 8 else None


def root_light(shot: Shot) -> tuple[np.ndarray, Camera]:
    """Square root of linear light (h, w, 3) float32, and its camera.

    In the root of light a surface's colour, the light on it and a camera's gain still multiply,
    and shot noise is the same everywhere (Anscombe 1948).
    """
    return np.sqrt(cv2.GaussianBlur(LIGHT_OF_LEVEL[shot.image], (0, 0), 0.7)), shot.camera


def detail(image: np.ndarray, shot: Shot, radius: float) -> np.ndarray:
    """An image (h, w, 3) less its mean over about `radius` pixels, taken within the matte.

    Highlights, shading and what is wrong with gains are broad; they differ from view to view and
    would drown the small marks of the skin that tell where it is.
    """
    if shot.alpha is None:
        return image - cv2.GaussianBlur(image, (0, 0), radius)
    inside = shot.alpha / np.float32(255.0) + np.float32(1e-3)
    mean = cv2.GaussianBlur(image * inside[..., None], (0, 0), radius)
    return image - mean / cv2.GaussianBlur(inside, (0, 0), radius)[..., None]
