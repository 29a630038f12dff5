"""Cast rays at meshes with Embree, through Open3D."""

from __future__ import annotations

import numpy as np
import open3d as o3d

from express50.geometry.cameras import Camera, rays


def mesh_scene(vertices: np.ndarray, faces: np.ndarray) -> o3d.t.geometry.RaycastingScene:
    """Make an Embree scene of a mesh (V, 3), (F, 3), on one thread."""
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor(np.ascontiguousarray(vertices, np.float32)),
        o3d.core.Tensor(np.ascontiguousarray(faces, np.uint32)),
    )
    return scene


def join_rays(origins: np.ndarray, directions: np.ndarray) -> o3d.core.Tensor:
    """Make rays (..., 6) for Open3D from origins and directions (..., 3), which broadcast."""
    both = np.broadcast_arrays(origins, directions)
    return o3d.core.Tensor(np.concatenate(both, axis=-1, dtype=np.float32))


def camera_rays(camera: Camera) -> o3d.core.Tensor:
    """Make a ray (H, W, 6) through each pixel centre; distance along it is depth, camera z."""
    return join_rays(*rays(camera))


def barycentrics(
    hits: dict[str, o3d.core.Tensor], hit: np.ndarray | slice = slice(None)
) -> np.ndarray:
    """Return the barycentric weights (N, 3) of the marked rays in the faces that they hit."""
    u, v = hits["primitive_uvs"].numpy()[hit].T
    return np.stack([1 - u - v, u, v], axis=1)


def visible_faces(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Find the face of a mesh (V, 3), (F, 3), metres, that each pixel of a pinhole camera sees.

    Face ids (H, W) are int64, -1 if there is none; depth (H, W) float64 is camera z in metres,
    infinite if there is none.
    """
    # Far from the origin float32 rays are too coarse, so rays are cast relative to the mesh centre.
    centre = vertices.mean(0)
    origin, directions = rays(camera)
    hit = mesh_scene(vertices - centre, faces).cast_rays(join_rays(origin - centre, directions))
    depth = hit["t_hit"].numpy().astype(np.float64)
    face = hit["primitive_ids"].numpy().astype(np.int64)
    return np.where(np.isfinite(depth), face, -1), depth
