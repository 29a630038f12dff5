"""Other ways to see which face a pixel shows: Open3D's rays, and the user's own nvdiffrast.

All take camera-space vertices (V, 3) float64, faces (F, 3) int32, a pinhole camera, the near plane
and whether to cull, and return face ids (H, W) int32, -1 for none, and depth (H, W) float32.
Open3D, torch and nvdiffrast are imported where they are used: most callers need none of them.
"""

from __future__ import annotations

import importlib.util

import numpy as np

from express50.geometry.cameras import Camera, rays


def see_open3d(
    xyz: np.ndarray, faces: np.ndarray, camera: Camera, near: float, cull: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Face ids and depth by Embree's rays through the pixel centres."""
    import open3d as o3d  # heavy, and only where the native library is missing

    from express50.geometry.raycast import mesh_scene

    faces, kept = _seen_faces(xyz, faces, near, cull)
    empty = np.full((camera.height, camera.width), -1, dtype=np.int32)
    if not len(faces):
        return empty, np.zeros(empty.shape, dtype=np.float32)
    still = Camera(camera.id, camera.width, camera.height, camera.model, camera.params, np.eye(4))
    directions = rays(still)[1].astype(np.float32)
    beams = np.concatenate([near * directions, directions], axis=-1).astype(np.float32)
    hit = mesh_scene(xyz, faces).cast_rays(o3d.core.Tensor(beams), nthreads=1)
    distance = hit["t_hit"].numpy() + np.float32(near)
    seen = np.isfinite(distance)
    face_id = np.where(seen, kept[np.where(seen, hit["primitive_ids"].numpy(), 0)], empty)
    return face_id.astype(np.int32), np.where(seen, distance, 0.0).astype(np.float32)


def _seen_faces(
    xyz: np.ndarray, faces: np.ndarray, near: float, cull: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Faces (K, 3) that reach beyond the near plane and are not culled, and their ids (K,)."""
    corners = xyz[faces]
    keep = corners[..., 2].max(axis=1, initial=-np.inf) >= near
    if cull:
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        keep &= (normals * corners[:, 0]).sum(axis=1) < 0
    kept = np.flatnonzero(keep)
    return faces[kept], kept


def see_nvdiffrast(
    xyz: np.ndarray, faces: np.ndarray, camera: Camera, near: float, cull: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Face ids by the user's own nvdiffrast on the GPU, and the depth of these faces."""
    import torch

    if importlib.util.find_spec("nvdiffrast") is None or not torch.cuda.is_available():
        raise ValueError(
            "rasterize: backend 'nvdiffrast' needs the package nvdiffrast and a CUDA device;"
            " install it or use backend='auto'"
        )
    import nvdiffrast.torch as dr

    faces, kept = _seen_faces(xyz, faces, near, cull)
    face_id = np.full((camera.height, camera.width), -1, dtype=np.int32)
    if not len(faces):
        return face_id, np.zeros(face_id.shape, dtype=np.float32)
    clip = torch.from_numpy(clip_space(xyz, camera, near)).float().cuda()[None]
    index = torch.from_numpy(faces).cuda()
    context = dr.RasterizeCudaContext()
    size = [camera.height, camera.width]
    drawn = dr.rasterize(context, clip, index, resolution=size)[0][0, ..., 3]
    found = drawn.cpu().numpy().astype(np.int64) - 1
    face_id = np.where(found >= 0, kept[found], -1).astype(np.int32)
    return face_id, _plane_depth(xyz, faces, camera, found)


def clip_space(xyz: np.ndarray, camera: Camera, near: float) -> np.ndarray:
    """OpenGL clip coordinates (V, 4) of camera-space vertices (V, 3); row 0 stays the first row.

    The far plane lies just behind the farthest vertex.
    """
    K, far = camera.K, max(2.0 * near, 1.01 * float(xyz[:, 2].max(initial=0.0)))
    z = xyz[:, 2]
    x = (2 * K[0, 2] / camera.width - 1) * z + 2 * K[0, 0] / camera.width * xyz[:, 0]
    y = (2 * K[1, 2] / camera.height - 1) * z + 2 * K[1, 1] / camera.height * xyz[:, 1]
    return np.stack([x, y, ((far + near) * z - 2 * far * near) / (far - near), z], axis=1)


def _plane_depth(
    xyz: np.ndarray, faces: np.ndarray, camera: Camera, found: np.ndarray
) -> np.ndarray:
    """Depth (H, W) float32 at which the pixels' rays meet the planes of faces ``found`` (H, W)."""
    K, (y, x) = camera.K, np.nonzero(found >= 0)
    a, b, c = (xyz[faces[found[y, x], corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    ray = np.stack([(x + 0.5 - K[0, 2]) / K[0, 0], (y + 0.5 - K[1, 2]) / K[1, 1], 1.0 + 0 * x], -1)
    depth = np.zeros(found.shape, dtype=np.float32)
    slope = (normal * ray).sum(-1)
    z = (normal * a).sum(-1) / np.where(slope == 0, 1.0, slope)
    corners_z = np.stack([a[:, 2], b[:, 2], c[:, 2]])
    depth[y, x] = np.clip(z, corners_z.min(0), corners_z.max(0))
    return depth
