"""Convert between pixel origins and camera axes; no other Python file shifts by half a pixel.

Inside the project, pixel coordinates start at the image's corner (the first pixel's centre is
(0.5, 0.5), as in COLMAP and gsplat) and cameras have OpenCV axes. OpenCV's own functions put the
origin at the first pixel's centre; OpenGL's cameras look along -z with y up.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

Places = TypeVar("Places")
FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
MIRROR_X = np.diag([-1.0, 1.0, 1.0, 1.0])  # pose of a camera whose pictures are mirrored


def opencv_pixels_to_corner(pixels: np.ndarray) -> np.ndarray:
    """Return corner-origin pixels (..., 2) of OpenCV's centre-origin pixels (..., 2)."""
    return np.asarray(pixels, dtype=np.float64) + 0.5


def corner_to_opencv_pixels(pixels: np.ndarray) -> np.ndarray:
    """Return OpenCV's centre-origin pixels (..., 2) of corner-origin pixels (..., 2)."""
    return np.asarray(pixels, dtype=np.float64) - 0.5


def mirror_pixels(pixels: np.ndarray, width: int) -> np.ndarray:
    """Return the pixels (N, 2) of an image flipped left to right, `width` pixels wide."""
    return np.stack([width - pixels[:, 0], pixels[:, 1]], axis=1)


def mirror_opencv_pixels(pixels: np.ndarray, width: int) -> np.ndarray:
    """Return OpenCV's pixels (N, 2) of an image flipped left to right, `width` pixels wide."""
    return corner_to_opencv_pixels(mirror_pixels(opencv_pixels_to_corner(pixels), width))


def K_to_opencv(K: np.ndarray) -> np.ndarray:
    """Return K (3, 3) as OpenCV's functions expect it (principal point less half a pixel)."""
    shifted = np.array(K, dtype=np.float64)
    shifted[:2, 2] -= 0.5
    return shifted


def K_from_opencv(K: np.ndarray) -> np.ndarray:
    """Return the corner-origin K (3, 3) for a K that an OpenCV function returned."""
    shifted = np.array(K, dtype=np.float64)
    shifted[:2, 2] += 0.5
    return shifted


def affine_to_opencv(matrix: np.ndarray) -> np.ndarray:
    """Return the affine (2, 3) between centre-origin pixels, as ``cv2.warpAffine`` expects it.

    ``matrix`` (2, 3) is the same map between corner-origin pixels.
    """
    shifted = np.array(matrix, dtype=np.float64)
    shifted[:, 2] += shifted[:, :2] @ [0.5, 0.5] - 0.5
    return shifted


def affine_from_opencv(matrix: np.ndarray) -> np.ndarray:
    """Return the affine (2, 3) between corner-origin pixels; undoes `affine_to_opencv`."""
    shifted = np.array(matrix, dtype=np.float64)
    shifted[:, 2] -= shifted[:, :2] @ [0.5, 0.5] - 0.5
    return shifted


def corner_to_cell(places: Places) -> Places:
    """Return fractional indices of corner-origin positions, for interpolation; cell 0 is [0, 1].

    Takes and returns an array or a tensor of any shape.
    """
    return places - 0.5  # type: ignore[operator,return-value]


def cell_to_corner(indices: Places) -> Places:
    """Return corner-origin positions of fractional indices: the inverse of ``corner_to_cell``."""
    return indices + 0.5  # type: ignore[operator,return-value]


def cell_centres(count: int) -> np.ndarray:
    """Return the corner-origin positions (count,) of the centres of a row of cells."""
    return np.arange(count) + 0.5


def cam_from_world_from_opengl(world_from_cam_gl: np.ndarray) -> np.ndarray:
    """Return ``cam_from_world`` (4, 4), OpenCV axes, of an OpenGL camera-to-world matrix (4, 4)."""
    return np.linalg.inv(np.asarray(world_from_cam_gl, dtype=np.float64) @ FLIP_YZ)


def opengl_from_cam_from_world(cam_from_world: np.ndarray) -> np.ndarray:
    """Return the OpenGL camera-to-world matrix (4, 4) of ``cam_from_world`` (4, 4), OpenCV axes."""
    return np.linalg.inv(np.asarray(cam_from_world, dtype=np.float64)) @ FLIP_YZ
