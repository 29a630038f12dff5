"""Sweep planes in every view and fuse them into a TSDF by Open3D: the usual baseline for depth."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import open3d as o3d

from express50.geometry.cameras import Camera
from express50.geometry.conventions import K_to_opencv
from pipelines.depth.views import INSIDE, DepthView, head_box

NEIGHBOURS, PLANES, WINDOW = 4, 128, 9
AGREE, TRUNCATION_VOXELS = 0.5, 4.0


def fuse(views: Sequence[DepthView], voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Fuse the views' sweeps: vertices (V, 3) and faces (F, 3); voxels in metres.

    Source: Curless and Levoy 1996, through Open3D.
    """
    volume = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (o3d.core.float32, o3d.core.float32), ((1,), (1,)),
        voxel_size=voxel, block_resolution=16, block_count=20_000,
    )  # fmt: skip
    low, high = head_box(views)
    for view in views:
        swept = sweep(view, _nearest(view, views), low, high)
        depth = o3d.t.geometry.Image(o3d.core.Tensor(swept[..., None]))
        # Open3D's pixel centres lie on whole numbers.
        pose = (
            o3d.core.Tensor(K_to_opencv(view.camera.K)),
            o3d.core.Tensor(view.camera.cam_from_world),
        )
        blocks = volume.compute_unique_block_coordinates(depth, *pose, 1.0, 1e3, TRUNCATION_VOXELS)
        volume.integrate(blocks, depth, *pose, 1.0, 1e3, TRUNCATION_VOXELS)
    mesh = volume.extract_triangle_mesh(weight_threshold=2.0)
    return mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()


def sweep(
    view: DepthView, others: Sequence[DepthView], low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Choose the best of PLANES planes through a box: depth (H, W), 0 where views disagree."""
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(-1, 3)
    z = corners @ view.camera.cam_from_world[2, :3] + view.camera.cam_from_world[2, 3]
    planes = 1.0 / np.linspace(1.0 / max(z.min(), 1e-3), 1.0 / z.max(), PLANES)
    rows, columns = (np.flatnonzero((view.alpha > INSIDE).any(k)) for k in (1, 0))
    top, left = int(rows[0]), int(columns[0])
    box = slice(top, int(rows[-1]) + 1), slice(left, int(columns[-1]) + 1)
    here = _moments(_grey(view)[box])
    greys = [(_grey(other), _rays_to(view.camera, other.camera)) for other in others]
    best = np.full(here[0].shape, AGREE, np.float32)
    depth = np.zeros_like(best)
    for plane in planes:
        scores = [_correlation(here, _warped(grey, moved, plane, (left, top), best.shape))
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
