"""Turn the tracked mesh into signed distances: close it, check it with the mattes, merge it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import open3d as o3d

from express50.geometry.cameras import rays
from express50.geometry.conventions import cell_to_corner
from express50.geometry.raycast import mesh_scene
from express50.geometry.sampling import bilinear
from pipelines.depth.views import DepthView

REACH = 0.015  # metres that the hull may rise above a mesh that is believed; more is hair, cloth
BORDER = 0.03  # metres from the mesh's open border over which belief fades in; collars are there
NECK = 0.08  # metres; an open border larger than this is a neck, not an eye or a nostril
# 26 directions to the neighbours of a cell, the six axes first, as a mesh hides most points there
_CELL: np.ndarray = (
    np.array(sorted(np.ndindex(3, 3, 3), key=lambda k: sum(abs(i - 1) for i in k))[1:]) - 1
)
DIRECTIONS = _CELL / np.linalg.norm(_CELL, axis=1, keepdims=True)


@dataclass(frozen=True)
class TrackedSolid:
    """A tracked mesh with caps over its holes, and those over large ones (the neck) as `border`."""

    scene: o3d.t.geometry.RaycastingScene
    border: o3d.t.geometry.RaycastingScene | None
    low: np.ndarray
    high: np.ndarray

    def merge(self, points: np.ndarray, hull: np.ndarray, reach: float) -> np.ndarray:
        """Blend the solid's distances into those (N,) to the hull, where under ``reach`` metres."""
        within = hull < reach
        points, own = points[within], hull[within]
        distance = self.distance(points)
        # The hull's height over the mesh is the same all along a normal, so that no shell is left.
        belief = self.belief(points, distance - own)
        merged = hull.copy()
        merged[within] += belief * (np.maximum(distance, own) - own)
        return merged

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Measure signed distances (N,) float32, metres, negative inside the closed mesh.

        A point is inside if all of 26 directions hit the mesh: parity and winding tests fail on the
        open sheets of eyes, teeth and mouth inside the skin.
        """
        query = o3d.core.Tensor(np.ascontiguousarray(points, np.float32))
        gap = self.scene.compute_distance(query, nthreads=1).numpy()
        inside = np.ones(len(points), bool)
        for direction in DIRECTIONS:
            left = np.flatnonzero(inside)
            row = np.concatenate([points[left], np.broadcast_to(direction, (len(left), 3))], axis=1)
            ray = o3d.core.Tensor(np.ascontiguousarray(row, np.float32))
            inside[left] = self.scene.test_occlusions(ray, nthreads=1).numpy()
        return np.where(inside, -gap, gap)

    def belief(self, points: np.ndarray, height: np.ndarray) -> np.ndarray:
        """Weigh the mesh, (N,) in [0, 1], at points (N, 3); the hull is ``height`` (N,) above."""
        near = np.clip(2.0 - height / REACH, 0, 1)
        if self.border is None:
            return near
        query = o3d.core.Tensor(np.ascontiguousarray(points, np.float32))
        edge = self.border.compute_distance(query, nthreads=1).numpy()
        return near * np.clip(edge / BORDER - 1.0, 0, 1)


def close_mesh(vertices: np.ndarray, faces: np.ndarray) -> TrackedSolid:
    """Close the tracked mesh (V, 3), (F, 3): holes get fans to their middles."""
    points, caps, borders = [vertices], [], []
    for loop in boundary_loops(faces):
        ring = vertices[loop]
        middle = len(vertices) + len(points) - 1
        points.append(ring.mean(0, keepdims=True))
        fan = np.stack([loop, np.roll(loop, -1), np.full(len(loop), middle)], axis=1)
        caps.append(fan)
        if np.ptp(ring, axis=0).max() > NECK:
            borders.append(fan)
    all_points = np.concatenate(points)
    scene = mesh_scene(all_points, np.concatenate([faces, *caps]))
    border = mesh_scene(all_points, np.concatenate(borders)) if borders else None
    return TrackedSolid(scene, border, vertices.min(0), vertices.max(0))


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Find closed chains of vertices along edges that only one triangle of (F, 3) has."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, first, count = np.unique(
        np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True
    )
    following = dict(map(tuple, edges[first[count == 1]].tolist()))
    loops = []
    while following:
        start, vertex = following.popitem()
        loop = [start]
        while vertex != start and vertex in following:
            loop.append(vertex)
            vertex = following.pop(vertex)
        if vertex == start and len(loop) > 2:
            loops.append(np.array(loop))
    return loops


def matte_agreement(views: Sequence[DepthView], vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the median over views of the mean matte where a mesh (V, 3), (F, 3) is seen."""
    scene = mesh_scene(vertices, faces)
    shares = []
    for view in views:
        origin, directions = rays(view.camera, stride=4)
        way = directions.reshape(-1, 3)
        row = np.concatenate([np.broadcast_to(origin, way.shape), way], axis=1)
        hit = scene.test_occlusions(o3d.core.Tensor(row.astype(np.float32)), nthreads=1).numpy()
        y, x = np.nonzero(hit.reshape(directions.shape[:2]))
        inside = (
            bilinear(view.alpha, cell_to_corner(np.stack([4 * x, 4 * y], 1))) if len(x) else [0.0]
        )
        shares.append(float(np.mean(inside)))
    return float(np.median(shares))
