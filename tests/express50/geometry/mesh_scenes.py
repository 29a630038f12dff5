"""Meshes, cameras and a slow oracle for the tests of the mesh rasteriser."""

from __future__ import annotations

import numpy as np

from express50.geometry.cameras import Camera
from express50.geometry.transforms import look_at


def camera(
    width: int, height: int, focal: float, pose: np.ndarray | None = None, name: str = "c"
) -> Camera:
    """A pinhole camera whose principal point is a little off the middle."""
    params = (focal, 1.1 * focal, 0.5 * width + 0.3, 0.5 * height - 0.2)
    return Camera(name, width, height, "PINHOLE", params, np.eye(4) if pose is None else pose)


def head_camera(size: int, angle: float = 0.3, name: str = "c") -> Camera:
    """A camera 1 m from a head at the origin."""
    eye = np.array([np.sin(angle), 0.1, np.cos(angle)])
    pose = look_at(eye, np.zeros(3), np.array([0.0, 1.0, 0.0]))
    return Camera(name, size, size, "PINHOLE", (2.2 * size, 2.2 * size, size / 2, size / 2), pose)


def sphere(rings: int = 12, radius: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A closed sphere of 2 * rings segments, faces counter-clockwise from outside."""
    segments = 2 * rings
    polar = np.pi * np.arange(1, rings) / rings
    around = 2 * np.pi * np.arange(segments) / segments
    y, ring = np.cos(polar)[:, None] + 0 * around, np.sin(polar)[:, None]
    middle = np.stack([ring * np.sin(around), y, ring * np.cos(around)], -1).reshape(-1, 3)
    vertices = np.concatenate([middle, [[0, 1, 0], [0, -1, 0]]]) * radius
    at = np.arange((rings - 1) * segments).reshape(rings - 1, segments)
    a, b = at[:-1], np.roll(at, -1, 1)[:-1]
    c, d = at[1:], np.roll(at, -1, 1)[1:]
    top, bottom = len(vertices) - 2, len(vertices) - 1
    first, last = at[0], at[-1]
    faces = [
        np.stack([a, c, d], -1).reshape(-1, 3),
        np.stack([a, d, b], -1).reshape(-1, 3),
        np.stack([np.full(segments, top), first, np.roll(first, -1)], -1),
        np.stack([np.full(segments, bottom), np.roll(last, -1), last], -1),
    ]
    return vertices, np.concatenate(faces)


def oracle(
    vertices: np.ndarray, faces: np.ndarray, view: Camera, near: float, margin: float = 1e-7
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Face ids, depth and which pixels are clear of every edge, tie and near plane, by brute force.

    Each ray is solved against each triangle for depth and two barycentric coordinates at once, so
    it shares no formula with the rasteriser.
    """
    xyz = vertices @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    K, shape = view.K, (view.height, view.width)
    y, x = np.mgrid[: view.height, : view.width]
    ray = np.stack([(x + 0.5 - K[0, 2]) / K[0, 0], (y + 0.5 - K[1, 2]) / K[1, 1], 1.0 + 0 * x], -1)
    best, face_id = np.full(shape, np.inf), np.full(shape, -1)
    clear = np.ones(shape, bool)
    for index, (a, b, c) in enumerate(xyz[faces]):
        # a + u (b - a) + v (c - a) = z ray
        system = np.broadcast_to(np.stack([b - a, c - a, a], -1), (*shape, 3, 3)).copy()
        system[..., 2] = -ray
        size = np.linalg.norm(b - a) * np.linalg.norm(c - a)
        if np.linalg.norm(np.cross(b - a, c - a)) <= 1e-14 * size or size == 0:
            continue
        determinant = np.linalg.det(system)
        usable = np.abs(determinant) > 1e-12 * size
        system[~usable] = np.eye(3)
        u, v, z = np.moveaxis(
            np.linalg.solve(system, np.broadcast_to(-a[:, None], (*shape, 3, 1))), -2, 0
        )[..., 0]
        weight = np.stack([u, v, 1 - u - v]).min(0)
        hit = usable & (weight > 0) & (z > near)
        beyond = np.abs(z - near) < margin * max(1.0, near)
        close = usable & (np.abs(weight) < margin * 1e2) & (z > 0.5 * near)
        clear &= usable & ~close & ~(hit & beyond)
        clear &= ~(hit & np.isfinite(best) & (np.abs(z - best) < 1e-5 * np.abs(z)))
        nearer = hit & (z < best)
        best[nearer], face_id[nearer] = z[nearer], index
    return face_id, np.where(face_id >= 0, best, 0.0), clear
