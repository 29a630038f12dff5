"""Projection and its slope in undistorted cameras, without the checks of `cameras.project`."""

from __future__ import annotations

import numpy as np

from express50.geometry.cameras import Camera

NEAREST_M = 1e-9


def project_pinhole(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (..., 2) and depth (...) of world points (..., 3) in an undistorted camera."""
    ray, depth, _ = _rays(camera, points)
    return ray * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2], depth


def inside_frame(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (S, 2) of world points (S, 3), and whether (S,) they lie in the image, a pixel in."""
    pixels, depth = project_pinhole(camera, points)
    size = np.array([camera.width, camera.height])
    return pixels, (depth > 1e-3) & (pixels >= 1.0).all(1) & (pixels <= size - 1.0).all(1)


def project_with_slope(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (..., 2) of world points (..., 3) and d pixel / d point (..., 2, 3)."""
    ray, _, safe = _rays(camera, points)
    rotation, K = camera.cam_from_world[:3, :3], camera.K
    focal = K[[0, 1], [0, 1]]
    slope = (rotation[:2] - ray[..., None] * rotation[2:]) / safe[..., None, None]
    return ray * focal + K[:2, 2], slope * focal[:, None]


def _rays(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image-plane coordinates (..., 2) at unit depth, depth (...), depth that is never zero."""
    local = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    depth = local[..., 2]
    safe = np.where(np.abs(depth) > NEAREST_M, depth, NEAREST_M)
    return local[..., :2] / safe[..., None], depth, safe
