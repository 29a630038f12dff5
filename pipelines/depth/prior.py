"""Turn the tracked mesh into signed distances: close it, check it with the mattes, merge it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from express50.geometry.cameras import inside_frame, rays, resized
from express50.geometry.conventions import cell_to_corner
from express50.geometry.meshes import open_edges
from express50.geometry.pixels import disc, shrunk_size
from express50.geometry.raycast import camera_rays, join_rays, mesh_scene
from express50.geometry.sampling import bilinear
from express50.geometry.transforms import unit
from express50.head.load import HeadTopology
from pipelines.depth.views import (
    DepthView,
    hull_distance,
    in_picture,
    project_fast,
    silhouette_distance,
)
from pipelines.regions.things import NEAR_M, FaceView

REACH = 0.015  # metres that the hull may lie above a mesh that is trusted; beyond is hair or cloth
BORDER = 0.03  # metres from the mesh's open border, where collars are, over which trust grows
BODY = 0.5  # metres that the body continues below the neck, and widens; shoulders are nearer
# Metres that shoulders may stand out from this body, unless few views limit what stands out.
SHOULDERS, FEW_VIEWS = 0.04, 4
EYES_M = 0.03  # metres from glasses within which the head is trusted, whatever the hull
WORN_M = 0.004  # radius about a place on glasses that shows glasses, or what is behind them
OUTLINE_SIDE = 512  # longest side, pixels, of the body's outlines: they count at the first level
FACE = ("face", "nose", "lips", "left_eye_region", "right_eye_region")  # but for the forehead
NECK = 0.08  # metres; an open border larger than this is a neck, not an eye or a nostril
# 26 directions to the neighbours of a cell, the axes first: a mesh hides most points along these.
_CELL: np.ndarray = (
    np.array(sorted(np.ndindex(3, 3, 3), key=lambda k: sum(abs(i - 1) for i in k))[1:]) - 1
)
DIRECTIONS = _CELL / np.linalg.norm(_CELL, axis=1, keepdims=True)


@dataclass(frozen=True)
class TrackedSolid:
    """A tracked mesh whose holes have caps; `border` are those over large holes (the neck).

    `body` continues below large holes, because silhouettes of a torso are not those of a head.
    `glasses` are places (n, 3) all over frames and lenses, `face_views` are those of a face with
    things in front of it. `bare` (F,) marks the triangles of a face without: it is trusted however
    far above it the hull lies, as it does over cheeks if views are few or far apart.
    """

    scene: o3d.t.geometry.RaycastingScene
    border: o3d.t.geometry.RaycastingScene | None
    body: o3d.t.geometry.RaycastingScene
    low: np.ndarray
    high: np.ndarray
    glasses: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    face_views: tuple[FaceView, ...] = ()
    bare: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))

    @cached_property
    def bare_px(self) -> list[np.ndarray]:
        """Return the signed distances (H, W), pixels, to the edge of what shows the face."""
        return [silhouette_distance(view.bare.astype(np.float32)) for view in self.face_views]

    def carved(self, points: np.ndarray, hull: np.ndarray) -> np.ndarray:
        """Return the hull's distances (N,), without space in front of the face that is empty."""
        for view, bare in zip(self.face_views, self.bare_px, strict=True):
            pixels, depth = project_fast(view.camera, points)
            inside = in_picture(view.camera, pixels, depth)
            before = bilinear(view.depth, pixels[inside]) - NEAR_M - depth[inside]
            beside = bilinear(bare, pixels[inside]) * depth[inside] / view.camera.K[0, 0]
            hull[inside] = np.maximum(hull[inside], np.minimum(before, beside))
        return hull

    def merge(
        self, points: np.ndarray, hull: np.ndarray, outlines: Sequence[DepthView], reach: float
    ) -> np.ndarray:
        """Blend the solid's distances into the hull's (N,), where these are below ``reach`` metres.

        Where the hull of the body's own `outlines` lies far above the body, no silhouette shows the
        surface. There it may lie no further in front of or behind the body than the mattes extend
        to its sides; below the neck, where the body is a guess, by up to `SHOULDERS` further.
        """
        within = hull < reach
        points, own = points[within], hull[within]
        distance = self.distance(points)
        # The hull's height over the mesh is the same along a normal, so that no shell is left.
        trust = self.trust(points, distance - own)
        merged = hull.copy()
        merged[within] += trust * (np.maximum(distance, own) - own)
        apart, beside = signed_distance(self.body, points), hull_distance(outlines, points)
        known = 1 - np.clip((apart - beside) / REACH - 1, 0, 1)
        limit = apart - np.maximum(beside, 0) - known * REACH
        if len(outlines) > FEW_VIEWS:
            limit -= np.clip(3 * (distance - apart), 0, SHOULDERS)  # 0 at the head
        merged[within] = np.maximum(merged[within], limit)
        return merged

    def outlines(self, views: Sequence[DepthView]) -> list[DepthView]:
        """Replace the views by small ones without colours, whose mattes are the body's own."""
        found = []
        for view in views:
            size = shrunk_size(view.camera.width, view.camera.height, OUTLINE_SIDE)
            camera = resized(view.camera, *size)
            mask = self.body.test_occlusions(camera_rays(camera), nthreads=1).numpy()
            alpha = mask.astype(np.float32)
            rgb = np.zeros((*alpha.shape, 3), np.uint8)
            found.append(DepthView(camera, rgb, alpha, silhouette_distance(alpha)))
        return found

    def without_glasses(self, views: Sequence[DepthView]) -> Sequence[DepthView]:
        """Clear the mattes where views show glasses; the silhouettes stay."""
        if not len(self.glasses):
            return views
        found = []
        for view in views:
            way = (view.camera.center - self.glasses).astype(np.float32)
            pixels, shown = inside_frame(view.camera, self.glasses)
            ray = join_rays(self.glasses, way)
            shown &= ~self.scene.test_occlusions(ray, nthreads=1).numpy()
            worn = np.zeros(view.alpha.shape, np.uint8)
            column, line = pixels[shown].astype(np.int64).T
            worn[line, column] = 1
            far = float(np.linalg.norm(way, axis=1).mean())
            radius = int(np.ceil(WORN_M * view.camera.K[0, 0] / far))
            alpha = np.where(cv2.dilate(worn, disc(radius)) > 0, np.float32(0), view.alpha)
            found.append(replace(view, alpha=alpha))
        return found

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Measure signed distances (N,) float32, metres, negative inside the closed mesh."""
        return signed_distance(self.scene, points)

    def trust(self, points: np.ndarray, height: np.ndarray) -> np.ndarray:
        """Weigh the mesh, (N,) in [0, 1], at points (N, 3); the hull is ``height`` (N,) above."""
        near = np.clip(2.0 - height / REACH, 0, 1)
        if len(self.glasses):
            near[cKDTree(self.glasses).query(points)[0] < EYES_M] = 1
        query = o3d.core.Tensor(np.ascontiguousarray(points, np.float32))
        if self.bare.any():
            nearest = self.scene.compute_closest_points(query, nthreads=1)["primitive_ids"].numpy()
            near[np.append(self.bare, False)[np.minimum(nearest, len(self.bare))]] = 1
        if self.border is None:
            return near
        edge = self.border.compute_distance(query, nthreads=1).numpy()
        return near * np.clip(edge / BORDER - 1.0, 0, 1)


def signed_distance(scene: o3d.t.geometry.RaycastingScene, points: np.ndarray) -> np.ndarray:
    """Measure distances (N,) float32, metres, of points (N, 3); negative inside a closed mesh.

    A point is inside if all of 26 directions hit the mesh: parity and winding tests fail on the
    open sheets of eyes, teeth and mouth inside the skin.
    """
    query = o3d.core.Tensor(np.ascontiguousarray(points, np.float32))
    gap = scene.compute_distance(query, nthreads=1).numpy()
    inside = np.ones(len(points), bool)
    for direction in DIRECTIONS:
        left = np.flatnonzero(inside)
        ray = join_rays(points[left], direction)
        inside[left] = scene.test_occlusions(ray, nthreads=1).numpy()
    return np.where(inside, -gap, gap)


def close_mesh(vertices: np.ndarray, faces: np.ndarray) -> TrackedSolid:
    """Close the tracked mesh (V, 3), (F, 3): holes get fans to their middles."""
    low, high = vertices.min(0), vertices.max(0)
    loops = boundary_loops(faces)
    middles = [vertices[loop].mean(0, keepdims=True) for loop in loops]
    caps = [_fan(loop, len(vertices) + k) for k, loop in enumerate(loops)]
    points, solid = [np.concatenate([vertices, *middles])], [np.concatenate([faces, *caps])]
    scene = mesh_scene(points[0], solid[0])
    large = [k for k, loop in enumerate(loops) if np.ptp(vertices[loop], axis=0).max() > NECK]
    if not large:
        return TrackedSolid(scene, None, scene, low, high)
    border = mesh_scene(points[0], np.concatenate([caps[k] for k in large]))
    for loop in (loops[k] for k in large):  # below, walls go down and outward and end in a cap
        ring, first = vertices[loop], sum(map(len, points))
        middle = ring.mean(0)
        down, outward = unit(middle - vertices.mean(0)), unit(ring - middle)
        lower = ring + BODY * (down + outward)
        row = first + np.arange(len(loop))
        wall = np.stack([loop, np.roll(loop, -1), np.roll(row, -1), row], axis=1)
        points.append(np.concatenate([lower, lower.mean(0, keepdims=True)]))
        solid += [wall[:, :3], wall[:, [0, 2, 3]], _fan(row, first + len(loop))]
    body = mesh_scene(np.concatenate(points), np.concatenate(solid))
    return TrackedSolid(scene, border, body, low, high)


def bare_triangles(model: HeadTopology) -> np.ndarray:
    """Mark the triangles (F,) of a head model's face, without the forehead, where hair hangs."""
    none = np.zeros(len(model.template), bool)
    face = np.any([model.regions.get(name, none) for name in FACE], axis=0)
    return (face & ~model.regions.get("forehead", none))[model.faces].all(1)


def _fan(loop: np.ndarray, middle: int) -> np.ndarray:
    return np.stack([loop, np.roll(loop, -1), np.full(len(loop), middle)], axis=1)


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Find closed chains of vertices along edges that only one triangle of (F, 3) has."""
    following = dict(map(tuple, open_edges(faces).tolist()))
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
        ray = join_rays(*rays(view.camera, stride=4))
        y, x = np.nonzero(scene.test_occlusions(ray, nthreads=1).numpy())
        places = cell_to_corner(np.stack([4 * x, 4 * y], 1))
        shares.append(float(np.mean(bilinear(view.alpha, places))) if len(x) else 0.0)
    return float(np.median(shares))
