"""Fuse imported depth maps to the surface that later stages read, by Open3D's voxel blocks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import open3d as o3d

from express50.errors import StageError
from express50.geometry.cameras import Camera
from express50.geometry.conventions import K_to_opencv
from express50.geometry.meshes import write_ply
from pipelines.imports.pictures import look_up

LEAST_VOXEL_M, VOXEL_PX = 0.0015, 1.4  # as depth's own
TRUNCATION = 4.0  # voxels
FARTHEST_M = 1e3
SURE = 3.0  # views of a point for full confidence


def write_fused(
    path: Path,
    cameras: Mapping[str, Camera],
    depths: Mapping[str, np.ndarray],
    pictures: Mapping[str, np.ndarray],
) -> int:
    """Write the fused surface of depths (H, W), metres, with colours; returns its vertices.

    Source: Curless and Levoy 1996, through Open3D.

    Raises:
        StageError: the maps hold no surface.
    """
    steps = [
        float(np.median(depth[depth > 0])) / cameras[name].K[0, 0]
        for name, depth in depths.items()
        if depth.any()
    ]
    if not steps:
        raise StageError(f"{path.name}: no depth map knows any pixel")
    voxel = max(LEAST_VOXEL_M, VOXEL_PX * float(np.median(steps)))
    centre = np.mean([camera.center for camera in cameras.values()], axis=0)
    volume = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (o3d.core.float32, o3d.core.float32), ((1,), (1,)),
        voxel_size=voxel, block_resolution=16, block_count=20_000,
    )  # fmt: skip
    for name, depth in depths.items():
        image = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth[..., None])))
        near = cameras[name].cam_from_world.copy()
        near[:3, 3] += near[:3, :3] @ centre  # Open3D's world is in single precision
        pose = o3d.core.Tensor(K_to_opencv(cameras[name].K)), o3d.core.Tensor(near)
        blocks = volume.compute_unique_block_coordinates(image, *pose, 1.0, FARTHEST_M, TRUNCATION)
        volume.integrate(blocks, image, *pose, 1.0, FARTHEST_M, TRUNCATION)
    mesh = volume.extract_triangle_mesh(weight_threshold=1.0)
    if not len(mesh.vertex.positions):
        raise StageError(f"{path.name}: the depth maps hold no surface")
    mesh.compute_vertex_normals()
    vertices = mesh.vertex.positions.numpy().astype(np.float64) + centre
    seen, colours = _seen(vertices, cameras, depths, pictures, TRUNCATION * voxel)
    columns = {f"n{axis}": mesh.vertex.normals.numpy()[:, k] for k, axis in enumerate("xyz")}
    columns |= {c: colours[:, k] for k, c in enumerate(("red", "green", "blue"))}
    columns["confidence"] = np.minimum(seen / SURE, 1.0).astype(np.float32)
    write_ply(path, vertices, mesh.triangle.indices.numpy(), columns)
    return len(vertices)


def _seen(
    vertices: np.ndarray,
    cameras: Mapping[str, Camera],
    depths: Mapping[str, np.ndarray],
    pictures: Mapping[str, np.ndarray],
    near: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Count the views that show each vertex (N,), and average their colours (N, 3) uint8."""
    count, total = np.zeros(len(vertices)), np.zeros((len(vertices), 3))
    for name, depth in depths.items():
        found, z = look_up(cameras[name], depth, vertices)
        shown = (found > 0) & (np.abs(found - z) < near)
        count += shown
        total[shown] += look_up(cameras[name], pictures[name], vertices[shown])[0]
    return count, np.rint(total / np.maximum(count, 1)[:, None]).astype(np.uint8)
