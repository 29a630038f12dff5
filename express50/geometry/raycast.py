"""Embree scenes of meshes, through Open3D."""

from __future__ import annotations

import numpy as np
import open3d as o3d

from express50.geometry.cameras import Camera, rays


def mesh_scene(vertices: np.ndarray, faces: np.ndarray) -> o3d.t.geometry.RaycastingScene:
    """Embree scene of a mesh (V, 3), (F, 3), on one thread."""
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor(np.ascontiguousarray(vertices, np.float32)),
        o3d.core.Tensor(np.ascontiguousarray(faces, np.uint32)),
    )
    return scene


def camera_rays(camera: Camera) -> o3d.core.Tensor:
    """A ray (H, W, 6) a pixel centre; distances along it are depth, camera z."""
    origin, directions = rays(camera)
    row = np.concatenate([np.broadcast_to(origin, directions.shape), directions], axis=-1)
    return o3d.core.Tensor(row.astype(np.float32))
