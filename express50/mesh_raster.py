"""Visibility of triangle meshes: which face each pixel sees, how deep, and where outlines run.

The z-buffer is native (express50/native/mesh.h). One call serves one view on one thread and lets go
of the interpreter, so callers run views in a thread pool. Without the native library Open3D casts
rays instead, which is several times slower and finds no outlines. What is differentiable is
computed from the result by express50/mesh_render.py.
"""

from __future__ import annotations

import ctypes
import importlib.util
import warnings
from dataclasses import dataclass

import numpy as np

from express50 import native
from express50.cameras import Camera, rays
from express50.checks import check_finite, check_shape

BACKENDS = ("native", "open3d", "nvdiffrast")


class _View(ctypes.Structure):
    """Mirror of ``MeshView`` in mesh.h."""

    _fields_ = [
        *((name, ctypes.c_double) for name in ("fx", "fy", "cx", "cy", "near")),
        *((name, ctypes.c_int32) for name in ("width", "height", "cull")),
    ]


@dataclass(frozen=True, eq=False)
class Raster:
    """What one camera sees of a mesh, at pixel centres.

    Attributes:
        face_id: (H, W) int32, the nearest face; -1 where there is none.
        depth: (H, W) float32, camera z in metres; 0 where there is no face.
        pairs: (P, 4) int32, neighbouring pixels that an outline parts: the flat index of the pixel
            on the outline's own surface, that of the other pixel, and the two vertices of the
            edge. None where they were not asked for or cannot be had.
    """

    face_id: np.ndarray
    depth: np.ndarray
    pairs: np.ndarray | None = None


def rasterize(
    vertices: np.ndarray,
    faces: np.ndarray,
    camera: Camera,
    *,
    near: float = 0.01,
    cull: bool = False,
    pairs: bool = True,
    neighbors: np.ndarray | None = None,
    backend: str = "auto",
) -> Raster:
    """Nearest face and depth of every pixel, and the pairs of pixels that outlines part.

    A pixel centre on an edge belongs to both its faces; of equal depths the lower face id wins.
    Faces without area are never seen. Parts nearer than ``near`` are cut off.

    Args:
        vertices: (V, 3) world, metres.
        faces: (F, 3) vertex ids, counter-clockwise from outside.
        camera: a camera without distortion (`express50.cameras.pinhole`).
        near: least camera z that is seen, metres, above 0.
        cull: leave out faces that are seen from behind.
        pairs: also look for outlines.
        neighbors: `face_neighbors(faces)`, where it is at hand; it is computed otherwise.
        backend: "native", "open3d", "nvdiffrast" (needs CUDA) or "auto": the native library, or
            Open3D with a warning where that is missing.

    Returns:
        The raster; `pairs` is None without the native library.

    Raises:
        ValueError: an array has a wrong shape, an id out of range or a value that is not finite,
            or the camera has distortion.
        NativeLibraryError: backend is "native" and the library is missing.
    """
    vertices, faces = _checked(vertices, faces, camera, near)
    backend = resolve_backend() if backend == "auto" else backend
    if backend not in BACKENDS:
        raise ValueError(f"backend is {backend!r}, expected auto, {', '.join(BACKENDS)}")
    R, t = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
    xyz = np.ascontiguousarray(vertices @ R.T + t)
    see = {"native": _see_native, "open3d": _see_open3d, "nvdiffrast": _see_nvdiffrast}[backend]
    face_id, depth = see(xyz, faces, camera, near, cull)
    if not pairs or not native.available():
        return Raster(face_id, depth)
    neighbors = face_neighbors(faces) if neighbors is None else neighbors
    check_shape("neighbors", neighbors, (len(faces), 3))
    return Raster(
        face_id, depth, _outline_pairs(xyz, faces, neighbors, camera, near, face_id, depth)
    )


def resolve_backend() -> str:
    """What "auto" stands for here; warns where that is not the native library.

    nvdiffrast is not chosen by itself: no machine with a GPU was at hand to measure it on.
    """
    if native.available():
        return "native"
    warnings.warn(
        f"meshes are seen by Open3D's rays, slowly and without outlines: {native.why_missing()}",
        stacklevel=3,
    )
    return "open3d"


def face_neighbors(faces: np.ndarray) -> np.ndarray:
    """Ids (F, 3) int32 of the faces across the edge opposite to each corner of faces (F, 3).

    -1 where the mesh ends, and where more than two faces meet in one edge.
    """
    faces = np.asarray(faces, dtype=np.int64).reshape(-1, 3)
    edges = np.sort(faces[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
    key = edges[:, 0] * (int(faces.max(initial=0)) + 1) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    key = key[order]
    same = key[1:] == key[:-1]
    # An edge of two faces is a run of exactly two equal keys.
    alone = np.concatenate([[False], same, [False]])
    pair = np.flatnonzero(same & ~alone[:-2] & ~alone[2:]) if len(same) else np.zeros(0, np.int64)
    found = np.full(3 * len(faces), -1, dtype=np.int32)
    left, right = order[pair], order[pair + 1]
    found[left], found[right] = right // 3, left // 3
    return found.reshape(-1, 3)


def _checked(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, near: float
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices as float64 and faces as int32, or a ValueError."""
    vertices = np.asarray(vertices, dtype=np.float64)
    faces = np.asarray(faces)
    check_shape("vertices", vertices, (None, 3), "rasterize")
    check_shape("faces", faces, (None, 3), "rasterize")
    check_finite("vertices", vertices, "rasterize")
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ValueError(
            f"rasterize: faces hold ids {faces.min()}..{faces.max()}, expected"
            f" 0..{len(vertices) - 1}"
        )
    if camera.dist.any():
        raise ValueError(
            f"rasterize: camera {camera.id!r} has distortion ({camera.model}); undistort the"
            " picture and pass express50.cameras.pinhole(camera)"
        )
    if not near > 0:
        raise ValueError(f"rasterize: near is {near}, expected metres above 0")
    return vertices, np.ascontiguousarray(faces, dtype=np.int32)


def _view(camera: Camera, near: float, cull: bool = False) -> _View:
    K = camera.K
    size = (camera.width, camera.height, int(cull))
    return _View(K[0, 0], K[1, 1], K[0, 2], K[1, 2], near, *size)


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _see_native(
    xyz: np.ndarray, faces: np.ndarray, camera: Camera, near: float, cull: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Face ids and depth by the native z-buffer."""
    face_id = np.empty((camera.height, camera.width), dtype=np.int32)
    depth = np.empty((camera.height, camera.width), dtype=np.float32)
    view = _view(camera, near, cull)
    function = native.load().mesh_rasterize
    function.restype = None
    function(
        ctypes.byref(view),
        _pointer(xyz),
        ctypes.c_int64(len(faces)),
        *(_pointer(array) for array in (faces, face_id, depth)),
    )
    return face_id, depth


def _outline_pairs(
    xyz: np.ndarray,
    faces: np.ndarray,
    neighbors: np.ndarray,
    camera: Camera,
    near: float,
    face_id: np.ndarray,
    depth: np.ndarray,
) -> np.ndarray:
    """Pairs (P, 4) of pixels that an outline parts."""
    neighbors = np.ascontiguousarray(neighbors, dtype=np.int32)
    pairs = np.empty((2 * face_id.size, 4), dtype=np.int32)  # pages that are not written cost none
    view = _view(camera, near)
    function = native.load().mesh_pairs
    function.restype = ctypes.c_int64
    count = function(
        ctypes.byref(view),
        _pointer(xyz),
        ctypes.c_int64(len(faces)),
        *(_pointer(array) for array in (faces, neighbors, face_id, depth, pairs)),
    )
    return pairs[:count].copy()


def _see_open3d(
    xyz: np.ndarray, faces: np.ndarray, camera: Camera, near: float, cull: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Face ids and depth by Embree's rays through the pixel centres."""
    import open3d as o3d  # heavy, and only where the native library is missing

    from express50.raycast import mesh_scene

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


def _see_nvdiffrast(
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
