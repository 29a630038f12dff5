"""Visibility of triangle meshes: which face each pixel sees, how deep, and where outlines run.

The z-buffer is native (express50/native/mesh.h). One call serves one view on one thread and lets go
of the interpreter, so callers run views in a thread pool. Without the native library Open3D casts
rays instead, which is several times slower and finds no outlines. What is differentiable is
computed from the result by express50/mesh_render.py.
"""

from __future__ import annotations

import ctypes
import warnings
from dataclasses import dataclass

import numpy as np

from express50 import native
from express50.geometry.cameras import Camera
from express50.geometry.mesh_backends import see_nvdiffrast, see_open3d
from express50.geometry.shapes import check_finite, check_shape

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
        camera: a camera without distortion (`express50.geometry.cameras.pinhole`).
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
    check_finite("vertices in camera space", xyz, f"rasterize: camera {camera.id!r}")
    see = {"native": _see_native, "open3d": see_open3d, "nvdiffrast": see_nvdiffrast}[backend]
    face_id, depth = see(xyz, faces, camera, near, cull)
    if not pairs or not native.available():
        return Raster(face_id, depth)
    neighbors = face_neighbors(faces) if neighbors is None else neighbors
    _check_ids("neighbors", neighbors, -1, len(faces))
    check_shape("neighbors", neighbors, (len(faces), 3), "rasterize")
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
    _check_ids("faces", faces, 0, len(vertices))
    if camera.dist.any():
        raise ValueError(
            f"rasterize: camera {camera.id!r} has distortion ({camera.model}); undistort the"
            " picture and pass express50.geometry.cameras.pinhole(camera)"
        )
    if not near > 0:
        raise ValueError(f"rasterize: near is {near}, expected metres above 0")
    return vertices, np.ascontiguousarray(faces, dtype=np.int32)


def _check_ids(name: str, ids: np.ndarray, first: int, end: int) -> None:
    """Raise a ValueError unless ids are whole numbers in [first, end): they are addresses."""
    if ids.size and not np.issubdtype(ids.dtype, np.integer):
        raise ValueError(f"rasterize: {name} are {ids.dtype}, expected whole numbers")
    if ids.size and (ids.min() < first or ids.max() >= end):
        raise ValueError(
            f"rasterize: {name} hold ids {ids.min()}..{ids.max()}, expected {first}..{end - 1}"
        )


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
