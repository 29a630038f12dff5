"""Sweep planes in every view and fuse them into a TSDF by Open3D: the usual baseline for depth."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from express50.geometry.cameras import Camera, depth_in
from express50.geometry.conventions import K_to_opencv
from express50.geometry.pixels import box_about
from pipelines.depth.views import INSIDE, DepthView, head_box
from pipelines.imports.pictures import fuse

NEIGHBOURS, PLANES, WINDOW = 4, 128, 9
AGREE = 0.5


def sweep_and_fuse(views: Sequence[DepthView], voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Fuse the views' sweeps: vertices (V, 3) and faces (F, 3); voxels in metres."""
    low, high = head_box(views)
    maps = ((view.camera, sweep(view, _nearest(view, views), low, high)) for view in views)
    centre = (low + high) / 2
    mesh = fuse(maps, centre, voxel, least_views=2.0)
    vertices = mesh.vertex.positions.numpy().astype(np.float64) + centre
    return vertices, mesh.triangle.indices.numpy()


def sweep(
    view: DepthView, others: Sequence[DepthView], low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Choose the best of PLANES planes through a box: depth (H, W), 0 where views disagree."""
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(-1, 3)
    z = depth_in(view.camera, corners)
    planes = 1.0 / np.linspace(1.0 / max(z.min(), 1e-3), 1.0 / z.max(), PLANES)
    box = box_about(view.alpha > INSIDE)
    corner = box[1].start, box[0].start
    here = _moments(_grey(view)[box])
    greys = [(_grey(other), _rays_to(view.camera, other.camera)) for other in others]
    best = np.full(here[0].shape, AGREE, np.float32)
    depth = np.zeros_like(best)
    for plane in planes:
        scores = [_correlation(here, _warped(grey, moved, plane, corner, best.shape))
                  for grey, moved in greys]  # fmt: skip
        score = np.sort(scores, axis=0)[-2:].mean(0)  # two of four: the others may be hidden
        better = score > best
        best[better], depth[better] = score[better], plane
    whole = np.zeros(view.alpha.shape, np.float32)
    whole[box] = depth
    return np.where(view.alpha > INSIDE, whole, 0)


def _nearest(view: DepthView, views: Sequence[DepthView]) -> list[DepthView]:
    others = [other for other in views if other is not view]
    away = [np.linalg.norm(other.camera.center - view.camera.center) for other in others]
    return [others[k] for k in np.argsort(away)[:NEIGHBOURS]]


def _grey(view: DepthView) -> np.ndarray:
    return cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)


def _rays_to(one: Camera, other: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return A (3, 3) and b (3,): depth * A @ (x, y, 1) + b is the other's z * (x, y, 1)."""
    motion = other.cam_from_world @ np.linalg.inv(one.cam_from_world)
    here, there = K_to_opencv(one.K), K_to_opencv(other.K)
    return there @ motion[:3, :3] @ np.linalg.inv(here), there @ motion[:3, 3]


def _warped(
    grey: np.ndarray,
    moved: tuple[np.ndarray, np.ndarray],
    plane: float,
    corner: tuple[int, int],
    shape: tuple[int, ...],
) -> np.ndarray:
    """Return a window of this view as another view's picture shows it, on a plane at a depth."""
    matrix = plane * moved[0]
    matrix[:, 2] += moved[1]
    window = np.array([[1, 0, corner[0]], [0, 1, corner[1]], [0, 0, 1.0]])
    matrix = matrix @ window
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(grey, matrix, shape[::-1], flags=flags)


def _moments(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    mean = cv2.blur(grey, (WINDOW, WINDOW))
    return grey, mean, np.maximum(cv2.blur(grey * grey, (WINDOW, WINDOW)) - mean * mean, 0.0)


def _correlation(here: tuple[np.ndarray, np.ndarray, np.ndarray], there: np.ndarray) -> np.ndarray:
    """Return zero-mean normalised cross-correlation (H, W) in windows; no texture gives about 0."""
    grey, mean, variance = here
    _, other, spread = _moments(there)
    joint = cv2.blur(grey * there, (WINDOW, WINDOW)) - mean * other
    return joint / np.sqrt((variance + 1.0) * (spread + 1.0))
