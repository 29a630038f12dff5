"""The bump head seen by a ring of cameras, as views that can be disturbed."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from express50.geometry.cameras import Camera, pinhole_camera
from pipelines.matte.stage import make_view
from pipelines.matte.visual_hull import MatteView, ball_of
from tests.pipelines.bump_head import render, ring

SIZE = 96


@lru_cache(maxsize=1)
def shots(count: int = 12) -> tuple[tuple[Camera, np.ndarray, np.ndarray], ...]:
    """Camera, image (H, W, 3) uint8 and alpha (H, W) float32 of every camera."""
    return tuple((camera, *render(camera)[:2]) for camera in ring(count, SIZE))


def make_views(side: int = SIZE, cameras: list[Camera] | None = None) -> list[MatteView]:
    """Fresh undisturbed views; `cameras` replace the ring's."""
    rig = cameras or [camera for camera, _, _ in shots()]
    ball = ball_of({camera.id: camera for camera in rig})
    assert ball is not None
    return [
        make_view(camera, ball, image, np.rint(alpha * 255).astype(np.uint8), side)
        for camera, (_, image, alpha) in zip(rig, shots(), strict=False)
    ]


def disc(x: float, y: float, radius: float, size: int = SIZE) -> np.ndarray:
    """Pixels (size, size) bool of a disc, in shares of the side."""
    rows, columns = np.mgrid[0:size, 0:size] / size
    return (columns - x) ** 2 + (rows - y) ** 2 < radius**2


def with_alpha(views: list[MatteView], changes: dict[int, np.ndarray]) -> list[MatteView]:
    """The views with other mattes (h, w) for some."""
    return [
        replace(v, alpha=changes[k].astype(np.float32)) if k in changes else v
        for k, v in enumerate(views)
    ]


def turned(camera: Camera) -> Camera:
    """A pinhole camera whose picture `np.rot90` turns."""
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, camera.width], [0.0, 0.0, 1.0]])
    axes = np.eye(4)
    axes[:2, :2] = turn[:2, :2]
    K = turn @ camera.K @ axes[:3, :3].T
    pose = axes @ camera.cam_from_world
    return pinhole_camera(camera.id, K, camera.height, camera.width, pose)
