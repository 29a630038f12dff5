"""Pictures that a camera with square pixels and a centred principal point would have taken.

Readers of ``transforms.json`` that know an angle of view only (GaussianAvatars among them) put the
principal point in the image's middle. Where a camera's lies elsewhere, its pictures are moved onto
a canvas around the principal point: nothing is cut off, and no reader is wrong.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from express50.files.images import resize_area
from express50.geometry.cameras import Camera, pinhole_camera
from express50.geometry.conventions import affine_to_opencv

NEAR_PX = 0.02  # what centring would move pixels by at most: not worth an interpolation


def centred(camera: Camera, factor: int = 1) -> Camera:
    """A pinhole camera at the same place whose image holds the given one's whole view.

    Its focal lengths are equal, its principal point is the middle, and ``factor`` divides its size.
    The camera itself, where that is true of it already, to NEAR_PX.
    """
    K = camera.K
    f = K[0, 0]
    away = np.abs(K[:2, 2] - (camera.width / 2, camera.height / 2)).max()
    divided = camera.width % factor == camera.height % factor == 0
    if divided and away + abs(K[1, 1] / f - 1) * camera.height <= NEAR_PX:
        return camera
    width = _whole(2 * max(K[0, 2], camera.width - K[0, 2]), factor)
    height = _whole(2 * max(K[1, 2], camera.height - K[1, 2]) * f / K[1, 1], factor)
    square = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]])
    return pinhole_camera(camera.id, square, width, height, camera.cam_from_world)


def _whole(length: float, factor: int) -> int:
    """Even number of pixels, a multiple of the factor, that holds a length, rounding aside."""
    return 2 * factor * math.ceil((length - 1e-6) / (2 * factor))


def seen_by(image: np.ndarray, camera: Camera, target: Camera, factor: int = 1) -> np.ndarray:
    """Image (H, W[, C]) of a pinhole camera as ``target``, at the same place, has it; 0 outside.

    It is made ``factor`` times smaller by averaging.
    """
    if target is not camera:
        matrix = (target.K @ np.linalg.inv(camera.K))[:2]
        image = cv2.warpAffine(
            image, affine_to_opencv(matrix), (target.width, target.height), flags=cv2.INTER_LINEAR
        )
    if factor == 1:
        return image
    return resize_area(image, target.width // factor, target.height // factor)


def rgba_png(image: np.ndarray, alpha: np.ndarray) -> bytes:
    """PNG bytes of an image (H, W, 3) uint8 with opacity (H, W) uint8, colours not multiplied."""
    pixels = np.ascontiguousarray(np.concatenate([image[..., ::-1], alpha[..., None]], -1))
    return cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes()


def flattened(image: np.ndarray, alpha: np.ndarray, level: int) -> np.ndarray:
    """Image (H, W, 3) uint8 over a grey background of one level, by alpha (H, W) uint8."""
    share = alpha[..., None] / np.float32(255)
    return np.rint(image * share + level * (1 - share)).astype(np.uint8)
