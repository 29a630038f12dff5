"""A tracked head as cameras see it: labels and depth by ray casting, and where its neck ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d

from express50.contract.segmentation_labels import LABELS
from express50.geometry.cameras import Camera, crop_camera, project, rays
from express50.geometry.raycast import mesh_scene
from pipelines.regions.labels import SCALP, HeadLabels

BEARINGS = 36  # around the neck, at which the height of its lower end is known
# Sheets that are seen from outside only; from within one looks through the neck's open end.
_OUTER = tuple(LABELS.index(name) for name in ("skin", "ears", "lips", "neck")) + (SCALP,)


@dataclass(frozen=True)
class NeckEnd:
    """Where the neck ends: a height by bearing, in axes of the head, level beyond the neck.

    Attributes:
        center: (3,) middle of the end, world.
        R: (3, 3) world from head axes; y up.
        heights: (BEARINGS,) metres over the middle.
    """

    center: np.ndarray
    R: np.ndarray
    heights: np.ndarray

    def height(self, points: np.ndarray) -> np.ndarray:
        """Metres (N,) of points (N, 3), world, over the end; negative below."""
        x, y, z = ((points - self.center) @ self.R).T
        place = np.arctan2(z, x) / (2 * np.pi) * BEARINGS
        return y - np.interp(place, np.arange(BEARINGS), self.heights, period=BEARINGS)


@dataclass(frozen=True)
class TrackedHead:
    """One expression's mesh, ready to be seen.

    Attributes:
        vertices: (V, 3) world, metres.
        labels: the head model's.
        end: where the neck ends; None where the model does not tell.
        center: (3,) that the scene is about, so that far subjects lose no digits.
        scene: rays in, triangles out.
    """

    vertices: np.ndarray
    labels: HeadLabels
    end: NeckEnd | None
    center: np.ndarray
    scene: o3d.t.geometry.RaycastingScene


def make_head(vertices: np.ndarray, R: np.ndarray, labels: HeadLabels) -> TrackedHead:
    """A head of tracked vertices (V, 3), world, and its rotation (3, 3), world from head."""
    center = vertices.mean(0)
    scene = mesh_scene(vertices - center, labels.faces)
    end = None if "torso" in labels.missing else _neck_end(vertices[labels.end], R)
    return TrackedHead(vertices, labels, end, center, scene)


def _neck_end(loop: np.ndarray, R: np.ndarray) -> NeckEnd:
    """The end through vertices (n, 3) around it."""
    center = 0.5 * (loop.min(0) + loop.max(0))
    x, y, z = ((loop - center) @ R).T
    place = np.arctan2(z, x) / (2 * np.pi) * BEARINGS
    order = np.argsort(place, kind="stable")
    heights = np.interp(np.arange(BEARINGS), place[order], y[order], period=BEARINGS)
    return NeckEnd(center, R, heights)


def see(head: TrackedHead, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """What a pinhole camera sees of a head alone.

    Returns:
        labels (H, W) uint8, 0 where it is not; depth (H, W) float32, camera z, metres, 0 there.
    """
    labels = np.zeros((camera.height, camera.width), np.uint8)
    depth = np.zeros(labels.shape, np.float32)
    x0, y0, x1, y1 = _window(head.vertices, camera)
    if x1 <= x0 or y1 <= y0:
        return labels, depth
    origin, directions = rays(crop_camera(camera, x0, y0, x1 - x0, y1 - y0))
    row = np.concatenate(
        [np.broadcast_to(origin - head.center, directions.shape), directions], axis=-1
    )
    hits = head.scene.cast_rays(o3d.core.Tensor(row.astype(np.float32)), nthreads=1)
    distance = hits["t_hit"].numpy()
    hit = np.isfinite(distance) & (distance > 0)
    u, v = hits["primitive_uvs"].numpy()[hit].T
    corner = np.stack([1 - u - v, u, v], axis=1).argmax(1)
    vertex = head.labels.faces[hits["primitive_ids"].numpy()[hit], corner]
    found = head.labels.vertices[vertex]
    away = (hits["primitive_normals"].numpy()[hit] * directions[hit]).sum(1) > 0
    found = np.where(away & np.isin(found, _OUTER), np.uint8(0), found)
    window = np.s_[y0:y1, x0:x1]
    labels[window][hit] = found
    depth[window][hit] = np.where(found > 0, distance[hit], 0)
    return labels, depth


def _window(vertices: np.ndarray, camera: Camera) -> tuple[int, int, int, int]:
    """Pixels x0, y0, x1, y1 of the image outside of which no ray meets the vertices."""
    pixels, depth = project(camera, vertices)
    size = np.array([camera.width, camera.height])
    if not (depth > 0).any():
        return 0, 0, 0, 0
    if not (depth > 0).all():
        return 0, 0, camera.width, camera.height
    low, high = np.clip([np.floor(pixels.min(0)), np.ceil(pixels.max(0))], 0, size).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])
