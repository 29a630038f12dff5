"""The tracked mesh as a signed distance: closed, checked with the mattes, merged with the hull."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import open3d as o3d

from express50.geometry.cameras import rays
from express50.geometry.conventions import cell_to_corner
from express50.geometry.raycast import mesh_scene
from pipelines.depth.grid import View, sample_image

REACH = (
    0.015  # metres of hull over the tracked mesh up to which it is believed; more is hair, cloth
)
BORDER = 0.03  # metres from the mesh's open border over which belief fades in; collars stand there


@dataclass(frozen=True)
class Prior:
    """A tracked mesh made solid.

    Attributes:
        scene: the mesh and the caps over its holes.
        border: scene of the caps over large holes (the neck), or None.
        low, high: (3,) corners of its box, metres.
    """

    scene: o3d.t.geometry.RaycastingScene
    border: o3d.t.geometry.RaycastingScene | None
    low: np.ndarray
    high: np.ndarray

    def merge(self, points: np.ndarray, hull: np.ndarray, reach: float) -> np.ndarray:
        """Distances (N,) to the hull at points (N, 3), the tracked solid's blended in near it.

        What lies ``reach`` metres outside the hull stays.
        """
        within = hull < reach
        points, own = points[within], hull[within]
        distance = self.distance(points)
        # the hull's height over the mesh is the same all along a normal, so that no shell is left
        belief = self.belief(points, distance - own)
        merged = hull.copy()
        merged[within] += belief * (np.maximum(distance, own) - own)
        return merged

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance (N,) float32, metres, negative inside the closed mesh."""
        query = o3d.core.Tensor(np.ascontiguousarray(points, np.float32))
        gap = self.scene.compute_distance(query, nthreads=1).numpy()
        return np.where(self._enclosed(points), -gap, gap)

    def belief(self, points: np.ndarray, height: np.ndarray) -> np.ndarray:
        """How far (N,) in [0, 1] the tracked surface counts at points (N, 3).

        ``height`` (N,) is how far, metres, the visual hull rises over the mesh there.
        """
        near = np.clip(2.0 - height / REACH, 0, 1)
        if self.border is None:
            return near
        query = o3d.core.Tensor(np.ascontiguousarray(points, np.float32))
        edge = self.border.compute_distance(query, nthreads=1).numpy()
        return near * np.clip(edge / BORDER - 1.0, 0, 1)

    def _enclosed(self, points: np.ndarray) -> np.ndarray:
        """Whether no straight way out exists (N,) in any of 26 directions.

        Parity and winding tests fail on a head model, whose eyeballs, teeth and mouth cavity are
        open sheets inside the skin; all of these count as inside here.
        """
        inside = np.ones(len(points), bool)
        for direction in _directions():
            left = np.flatnonzero(inside)
            row = np.concatenate([points[left], np.broadcast_to(direction, (len(left), 3))], axis=1)
            ray = o3d.core.Tensor(np.ascontiguousarray(row, np.float32))
            inside[left] = self.scene.test_occlusions(ray, nthreads=1).numpy()
        return inside


def _directions() -> np.ndarray:
    """26 unit vectors (26, 3) to the neighbours of a cell, the six axes first."""
    cell = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
    cell = cell[np.abs(cell).sum(1) > 0]
    cell = cell[np.argsort(np.abs(cell).sum(1), kind="stable")]
    return cell / np.linalg.norm(cell, axis=1, keepdims=True)


def make_prior(vertices: np.ndarray, faces: np.ndarray) -> Prior:
    """A prior of the tracked mesh (V, 3), (F, 3); holes are closed by fans to their middles."""
    vertices = np.asarray(vertices, np.float64)
    points, caps = [vertices], []
    borders = []
    for loop in boundary_loops(faces):
        ring = vertices[loop]
        middle = len(vertices) + len(points) - 1
        points.append(ring.mean(0, keepdims=True))
        fan = np.stack([loop, np.roll(loop, -1), np.full(len(loop), middle)], axis=1)
        caps.append(fan)
        if np.ptp(ring, axis=0).max() > 0.08:  # a neck, not an eye or a nostril
            borders.append(fan)
    all_points = np.concatenate(points)
    scene = mesh_scene(all_points, np.concatenate([faces, *caps]))
    border = mesh_scene(all_points, np.concatenate(borders)) if borders else None
    return Prior(scene, border, vertices.min(0), vertices.max(0))


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Closed chains of vertex indices along edges that only one triangle (of (F, 3)) has."""
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


def matte_agreement(views: Sequence[View], vertices: np.ndarray, faces: np.ndarray) -> float:
    """Share of the pixels that a mesh (V, 3), (F, 3) covers which lie in the mattes.

    The median over views of the mean matte there; a view that the mesh does not reach counts 0.
    """
    scene = mesh_scene(vertices, faces)
    shares = []
    for view in views:
        origin, directions = rays(view.camera, stride=4)
        way = directions.reshape(-1, 3)
        row = np.concatenate([np.broadcast_to(origin, way.shape), way], axis=1)
        hit = scene.test_occlusions(o3d.core.Tensor(row.astype(np.float32)), nthreads=1).numpy()
        y, x = np.nonzero(hit.reshape(directions.shape[:2]))
        inside = (
            sample_image(view.alpha, cell_to_corner(np.stack([4 * x, 4 * y], 1)))
            if len(x)
            else [0.0]
        )
        shares.append(float(np.mean(inside)))
    return float(np.median(shares))
