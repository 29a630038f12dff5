"""An analytic head (ellipsoid, nose, eye sockets) with a painted skin, ray-cast in a ring."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import open3d as o3d
from skimage.measure import marching_cubes

from express50.geometry.cameras import Camera, pinhole_camera, rays
from express50.geometry.transforms import look_at

RADII = np.array([0.075, 0.105, 0.09])

BACKGROUND = np.array([0.3, 0.5, 0.4])


def distance(points: np.ndarray) -> np.ndarray:
    """Approximate signed distance (N,), metres, of points (N, 3)."""
    scaled = points / RADII
    norm = np.linalg.norm(scaled, axis=1)
    slope = np.linalg.norm(scaled / RADII, axis=1) / np.maximum(norm, 1e-9)
    base = (norm - 1) / np.maximum(slope, 1e-9)

    def bump(center, width):
        return np.exp(-0.5 * ((points - center) ** 2).sum(1) / width**2)

    nose = 0.018 * bump([0, -0.01, 0.09], 0.014)
    sockets = sum(0.008 * bump([side, 0.025, 0.08], 0.014) for side in (-0.03, 0.03))
    return base - nose + sockets


@lru_cache(maxsize=1)
def mesh(voxel: float = 0.002) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3)."""
    half = np.array([0.09, 0.12, 0.13])
    shape = np.ceil(2 * half / voxel).astype(int)
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    values = distance(index * voxel - half).reshape(shape)
    vertices, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="ascent")
    return vertices * voxel - half, faces.astype(np.int64)


def ring(count: int, size: int, arc_deg: float = 300.0, offset=(0.0, 0.0, 0.0)) -> list[Camera]:
    """Cameras 1.1 m away on an arc around +z, at three heights, looking at ``offset``."""
    cameras = []
    for k in range(count):
        angle = np.radians((k - (count - 1) / 2) * arc_deg / max(count, 1))
        rise = (-0.2, 0.1, 0.4)[k % 3]
        way = [np.sin(angle) * np.cos(rise), np.sin(rise), np.cos(angle) * np.cos(rise)]
        target = np.asarray(offset, float)
        pose = look_at(target + 1.1 * np.array(way), target)
        K = np.array([[3.4 * size, 0, size / 2 + 1.3], [0, 3.4 * size, size / 2], [0, 0, 1.0]])
        cameras.append(pinhole_camera(f"cam{k:02d}", K, size, size, pose))
    return cameras


def paint(points: np.ndarray) -> np.ndarray:
    """Skin brightness (N,) of surface points (N, 3): sums of waves of 5 to 40 mm."""
    rng = np.random.default_rng(0)
    total = np.zeros(len(points))
    for wave_mm in np.repeat([40.0, 20.0, 10.0, 5.0], 6):
        way = rng.normal(size=3)
        way *= 2 * np.pi / (wave_mm * 1e-3) / np.linalg.norm(way)
        total += np.sin(points @ way + rng.uniform(0, 6.28))
    return 1 + 0.025 * total


def render(camera: Camera, offset=(0.0, 0.0, 0.0), supersample: int = 2):
    """rgb (H, W, 3) uint8, alpha (H, W) float32, depth (H, W), 0 where there is none."""
    vertices, faces = mesh()
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor((vertices + offset).astype(np.float32)),
        o3d.core.Tensor(faces.astype(np.uint32)),
    )
    n, height, width = supersample, camera.height, camera.width
    K = camera.K * [[n, n, n], [n, n, n], [1, 1, 1]]
    fine = pinhole_camera("fine", K, width * n, height * n, camera.cam_from_world)
    depth, points, normals = _cast(scene, fine)
    hit = depth > 0
    shade = np.zeros((*depth.shape, 3)) + BACKGROUND
    light = 0.4 + 0.6 * np.clip(normals @ np.array([0.4, 0.6, 0.69]), 0, 1)
    skin = np.array([0.8, 0.6, 0.5]) * (paint(points - offset) * light)[:, None]
    shade[hit] = np.clip(skin, 0, 1)
    blocks = shade.reshape(height, n, width, n, 3).mean((1, 3))
    alpha = hit.reshape(height, n, width, n).mean((1, 3)).astype(np.float32)
    return np.rint(blocks * 255).astype(np.uint8), alpha, _cast(scene, camera)[0]


def _cast(scene, camera: Camera):
    origin, directions = rays(camera)
    row = np.concatenate([np.broadcast_to(origin, directions.shape), directions], -1)
    hits = scene.cast_rays(o3d.core.Tensor(row.astype(np.float32)), nthreads=1)
    depth = hits["t_hit"].numpy()
    hit = np.isfinite(depth)
    normals = hits["primitive_normals"].numpy()[hit]
    points = origin + directions[hit] * depth[hit][:, None]
    return np.where(hit, depth, 0), points, normals
