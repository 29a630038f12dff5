"""Crop heads, sample their skin, and weigh how well each camera sees the samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import cKDTree

from express50.geometry.cameras import Camera, cut_about, inside_frame, project_pinhole, resized
from express50.geometry.pixels import LIGHT_OF_LEVEL, disc, resize_area
from express50.geometry.raycast import join_rays, mesh_scene
from express50.geometry.sampling import bilinear_slope
from express50.geometry.transforms import unit
from express50.head.model import HeadModel, in_regions
from pipelines.track.terms import MeshPlaces

UNCOVERED_SKIN = (
    "face", "nose", "lips",
    "left_eye_region", "right_eye_region", "left_eyeball", "right_eyeball",
)  # fmt: skip
FEATURES = (
    "lips", "left_eye_region", "right_eye_region", "left_eyeball", "right_eyeball",
    "mouth_interior", "teeth", "tongue",
)  # fmt: skip
# Skin that hair or cloth may cover: its shape can be searched for, but its colours are not trusted.
COVERED = ("neck", "left_ear", "right_ear")
HIDDEN = ("mouth_interior", "boundary", "scalp", "teeth", "tongue")
TOUCH_M = 3e-4  # a ray that ends this far in front of a sample still reaches it
HEAD_M = 0.5  # rays begin this far in front of a sample: only the head itself can hide it
GRAZING = 0.25  # least cosine between a normal and the direction to the camera
THING_M = 0.005  # radius of the patch of surface that a place on a thing stands for
MARGIN = 0.15  # around the head in its crop, as a share of the head's size


@dataclass(frozen=True)
class HeadCrop:
    """One camera's picture of a frame set, cropped to the head."""

    camera: Camera  # the crop's
    image: np.ndarray  # (H, W, 3) uint8 sRGB
    alpha: np.ndarray | None  # (H, W) uint8, 255 where the subject is


@dataclass(frozen=True)
class SignedDistance:
    """Signed distance to a matte's edge."""

    values: np.ndarray  # (H, W) pixels of the camera, positive outside
    camera: Camera
    step: np.ndarray  # (2,) pixels of the camera that a cell is wide and high


@dataclass(frozen=True)
class FrameSetCrops:
    """The pictures of one frame set: distances to its mattes' outlines, and head crops.

    `lit` are the crops' `root_light`, if they are kept: they take twelve times the memory.
    """

    distances: tuple[SignedDistance, ...]
    crops: tuple[HeadCrop, ...]
    lit: tuple[tuple[np.ndarray, Camera], ...] | None = None

    def some(self, ids: list[int]) -> FrameSetCrops:
        """Choose crops by index."""
        lit = None if self.lit is None else tuple(self.lit[k] for k in ids)
        return FrameSetCrops(self.distances, tuple(self.crops[k] for k in ids), lit)

    def images(self) -> list[tuple[np.ndarray, Camera]]:
        """Return the crops' `root_light`."""
        return [root_light(crop) for crop in self.crops] if self.lit is None else list(self.lit)


CutCrops = Callable[[np.ndarray], FrameSetCrops]
"""Cut the crops of a frame set about its mesh (V, 3)."""


def cut_crop(
    camera: Camera, image: np.ndarray, alpha: np.ndarray | None, mesh: np.ndarray, side: int
) -> HeadCrop | None:
    """Crop an undistorted frame (H, W, 3) to a mesh (V, 3) and shrink it to at most `side` pixels.

    Returns None where the head is behind the camera or (almost) outside the frame.
    """
    pixels, depth = project_pinhole(camera, mesh)
    if (depth <= 1e-3).any():
        return None
    seen, window = cut_about(camera, pixels, MARGIN * np.ptp(pixels, axis=0).max())
    if min(seen.width, seen.height) < 8:
        return None
    image = np.ascontiguousarray(image[window])
    alpha = None if alpha is None else np.ascontiguousarray(alpha[window])
    step = max(seen.width, seen.height) / side
    if step > 1.0:
        width, height = max(8, round(seen.width / step)), max(8, round(seen.height / step))
        seen = resized(seen, width, height)
        image = resize_area(image, width, height)
        alpha = None if alpha is None else resize_area(alpha, width, height)
    return HeadCrop(seen, image, alpha)


def root_light(crop: HeadCrop) -> tuple[np.ndarray, Camera]:
    """Return a crop's root of linear light (h, w, 3) float32, and its camera.

    In the root of light a surface's colour, the light on it and a camera's gain still multiply,
    and shot noise is the same everywhere (Anscombe 1948).
    """
    return np.sqrt(cv2.GaussianBlur(LIGHT_OF_LEVEL[crop.image], (0, 0), 0.7)), crop.camera


def matte_weights(crop: HeadCrop, places: np.ndarray) -> np.ndarray:
    """Weigh places (S, 3) by the matte (S,): 0 outside the picture or the subject, at most 1."""
    pixels, inside = inside_frame(crop.camera, places)
    if crop.alpha is None:
        return inside.astype(np.float64)
    size = np.array([crop.camera.width, crop.camera.height])
    column, row = np.clip(pixels.astype(np.int64), 0, size - 1).T
    return inside * (crop.alpha[row, column] / 255.0)


def mask_things(pictures: FrameSetCrops, things: np.ndarray) -> FrameSetCrops:
    """Clear the crops' mattes where places (n, 3) on the surface of things hide the head."""
    if not len(things):
        return pictures
    crops = []
    for crop in pictures.crops:
        seen = np.zeros(crop.image.shape[:2], np.uint8)
        pixels, inside = inside_frame(crop.camera, things)
        column, row = pixels[inside].astype(np.int64).T
        seen[row, column] = 1
        far = float(np.linalg.norm(things - crop.camera.center, axis=1).mean())
        hidden = cv2.dilate(seen, disc(max(1, round(THING_M * crop.camera.K[0, 0] / far)))) > 0
        whole = np.full(seen.shape, 255, np.uint8) if crop.alpha is None else crop.alpha
        crops.append(replace(crop, alpha=np.where(hidden, np.uint8(0), whole)))
    return replace(pictures, crops=tuple(crops))


def near_things(
    things: np.ndarray, camera: Camera, pixels: np.ndarray, within: float = THING_M
) -> np.ndarray:
    """Return which pixels (N, 2) of a camera lie `within` metres of things' places (n, 3)."""
    if not len(things):
        return np.zeros(len(pixels), bool)
    shown, ahead = project_pinhole(camera, things)
    reach = within * camera.K[0, 0] / max(float(np.median(ahead)), 1e-3)
    return cKDTree(shown).query(pixels)[0] < reach


def look_up(camera: Camera, image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Interpolate a picture (H, W, C) at world points (S, 3): values (S, C)."""
    return bilinear_slope(image, project_pinhole(camera, places)[0])[0]


def spread_samples(
    model: HeadModel, count: int, regions: tuple[str, ...] = UNCOVERED_SKIN
) -> MeshPlaces:
    """Spread about `count` samples evenly by area over the skin of the template's regions.

    The same model, count and regions give the same samples.
    """
    faces = model.faces.numpy()
    allowed = (in_regions(model, regions) & ~in_regions(model, HIDDEN))[faces].all(1)
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
    return MeshPlaces(faces[chosen], bary)


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


def sample_normals(samples: MeshPlaces, vertices: np.ndarray) -> np.ndarray:
    """Return unit normals (S, 3) of the samples' faces on vertices (V, 3)."""
    a, b, c = (vertices[samples.vertices[:, k]] for k in range(3))
    return unit(np.cross(b - a, c - a))


class Visibility:
    """Ray casting against one mesh for many cameras; the ray tree is built once."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        # Far from the origin float32 rays are too coarse: they are relative to the mesh's centre.
        self.centre = vertices.mean(0)
        self.scene = mesh_scene(vertices - self.centre, faces)

    def weights(self, camera: Camera, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Weigh a camera's view of points (S, 3): (S,) in 0..1.

        0 where the mesh hides a point or faces away, else the cosine to the camera: at a grazing
        angle, a pixel covers much of the surface, and a small error of shape moves it far.
        """
        ray = points - camera.center
        distance = np.linalg.norm(ray, axis=1)
        direction = ray / np.maximum(distance, 1e-12)[:, None]
        cosine = -(direction * normals).sum(1)
        chosen = np.flatnonzero(cosine > GRAZING)
        reach = np.minimum(HEAD_M, distance[chosen])
        origin = points[chosen] - self.centre - reach[:, None] * direction[chosen]
        hit = self.scene.cast_rays(join_rays(origin, direction[chosen]))["t_hit"].numpy()
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


def view_colours(
    images: list[tuple[np.ndarray, Camera]], weights: np.ndarray, places: np.ndarray
) -> np.ndarray:
    """Look up places (S, 3) in C pictures of `root_light`: (C, S, 3), 0 where the weight is 0."""
    values = np.zeros((*weights.shape, 3))
    for value, weight, (image, camera) in zip(values, weights, images, strict=True):
        seen = np.flatnonzero(weight)
        value[seen] = look_up(camera, image, places[seen])
    return values
