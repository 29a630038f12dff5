"""Samples of the skin, and how well each camera sees them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d

from express50.geometry.cameras import Camera
from express50.geometry.raycast import mesh_scene
from express50.head.model import HeadModel
from pipelines.track.crops import FrameSetCrops, matte_weights

SEEN = (
    "face", "nose", "lips",
    "left_eye_region", "right_eye_region", "left_eyeball", "right_eyeball",
)  # fmt: skip
# Skin that hair and cloth may lie before: its shape can be searched for, its colours not trusted.
COVERED = ("neck", "left_ear", "right_ear")
HIDDEN = ("mouth_interior", "boundary", "scalp", "teeth", "tongue")
# A ray may end this far before a sample and still count as reaching it: a tenth of a hair.
TOUCH_M = 3e-4
# What hides a sample is part of the head: rays begin so far before it, none behind its camera.
HEAD_M = 0.5
GRAZING = 0.25


@dataclass(frozen=True)
class Samples:
    """Fixed places on a mesh.

    Attributes:
        faces: (S,) face ids.
        corners: (S, 3) vertex ids.
        bary: (S, 3) barycentric weights.
    """

    faces: np.ndarray
    corners: np.ndarray
    bary: np.ndarray

    def some(self, ids: np.ndarray | slice) -> Samples:
        """Choose samples by index, mask or slice."""
        return Samples(self.faces[ids], self.corners[ids], self.bary[ids])

    def at(self, vertices: np.ndarray) -> np.ndarray:
        """Place the samples (S, 3) on vertices (V, 3)."""
        return np.einsum("sk,skc->sc", self.bary, vertices[self.corners])


def spread(model: HeadModel, count: int, regions: tuple[str, ...] = SEEN) -> Samples:
    """Spread about `count` samples evenly by area over the skin of the template's regions.

    The same model, count and regions give the same samples.
    """
    faces = model.faces.numpy()
    none = np.zeros(len(model.template), dtype=bool)

    def union(names: tuple[str, ...]) -> np.ndarray:
        return np.any([none, *(model.regions[n].numpy() for n in names if n in model.regions)], 0)

    allowed = (union(regions) & ~union(HIDDEN))[faces].all(1)
    # A head that names no such region is taken to be skin all over.
    ids = np.flatnonzero(allowed) if allowed.any() else np.arange(len(faces))
    corners = model.template.double().numpy()[faces[ids]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    # Systematic sampling along the faces' running area: no face gets more than its share and one.
    places = (np.arange(count) + 0.5) / count * area.sum()
    chosen = ids[np.searchsorted(np.cumsum(area), places).clip(0, len(ids) - 1)]
    # Evenly spread pairs in the unit square: the R2 sequence (Roberts 2018).
    step = np.arange(1, count + 1)
    u, v = (0.5 + 0.7548776662466927 * step) % 1.0, (0.5 + 0.5698402909980532 * step) % 1.0
    root = np.sqrt(u)
    bary = np.stack([1 - root, root * (1 - v), root * v], axis=1)
    return Samples(chosen, faces[chosen], bary)


def flat_barycentrics(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return barycentric weights (N, 3) of triangles (N, 3, 2) at points (N, 2) in or near them."""
    a, b, c = np.moveaxis(corners, 1, 0)
    u, v, w = b - a, c - a, points - a
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    area = np.where(np.abs(area) < 1e-12, 1e-12, area)
    second = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / area
    third = (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]) / area
    bary = np.clip(np.stack([1.0 - second - third, second, third], axis=1), 0.0, 1.0)
    return bary / bary.sum(1, keepdims=True)


def sample_normals(samples: Samples, vertices: np.ndarray) -> np.ndarray:
    """Return unit normals (S, 3) of the samples' faces on vertices (V, 3)."""
    a, b, c = (vertices[samples.corners[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)


class Visibility:
    """Ray casting against one mesh for many cameras; the ray tree is built once."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        # Far from the origin float32 rays are too coarse: all is cast about the mesh's centre.
        self.centre = vertices.mean(0)
        self.scene = mesh_scene(vertices - self.centre, faces)

    def weights(self, camera: Camera, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Weigh a camera's view of points (S, 3): (S,) in 0..1.

        0 where the mesh hides a point or turns it away, else the cosine to the camera; at a
        grazing angle a pixel covers much of the surface and a small error of shape moves it far.
        """
        ray = points - camera.center
        distance = np.linalg.norm(ray, axis=1)
        direction = ray / np.maximum(distance, 1e-12)[:, None]
        cosine = -(direction * normals).sum(1)
        chosen = np.flatnonzero(cosine > GRAZING)
        reach = np.minimum(HEAD_M, distance[chosen])
        origin = points[chosen] - self.centre - reach[:, None] * direction[chosen]
        cast = np.concatenate([origin, direction[chosen]], axis=1).astype(np.float32)
        hit = self.scene.cast_rays(o3d.core.Tensor(cast))["t_hit"].numpy()
        clear = hit > reach - TOUCH_M
        weights = np.zeros(len(points))
        weights[chosen] = np.where(clear, cosine[chosen], 0.0)
        return weights


def view_weights(
    visibility: Visibility, pictures: FrameSetCrops, places: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Weigh the views (C, S) of places (S, 3): cosine to the camera, 0 where hidden."""
    rows = [
        visibility.weights(crop.camera, places, normals) * matte_weights(crop, places)
        for crop in pictures.crops
    ]
    return np.array(rows).reshape(-1, len(places))
