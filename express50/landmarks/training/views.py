"""Rendered views of random heads, and the files that hold them.

A view has a picture, landmarks, and which of them the head hides. A file of views is made once; it
depends on the seed, the head model and its number alone.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d

from express50.geometry.raycast import mesh_scene
from express50.head.model import HeadModel
from express50.landmarks.training.random_heads import RandomHead, random_head

FRAME_SIDE_M = 0.38
# A landmark counts as seen if nothing lies further than this in front of it.
HIDING_M = 0.005
Rng = np.random.Generator


@dataclass(frozen=True)
class TrainingView:
    """A rendered view.

    Attributes:
        rgba: (S, S, 4) uint8, black where empty.
        points: (68, 2) pixels, corner origin.
        visible: (68,) bool, nothing of the head is before the landmark.
        facing: cosine between the face's forward direction and the direction to the camera.
    """

    rgba: np.ndarray
    points: np.ndarray
    visible: np.ndarray
    facing: float


class HeadScene:
    """A random head in a ray caster, to be seen from many sides."""

    def __init__(self, model: HeadModel, head: RandomHead) -> None:
        self.faces = model.faces.numpy()
        self.head = head
        self.scene = mesh_scene(head.vertices, self.faces)

    def render(self, rng: Rng, side: int, yaw: float) -> TrainingView:
        """Render (side, side) pixels from a yaw in radians, 0 in front; the rest is random."""
        points = self.head.landmarks
        K, cam_from_world = _random_camera(points, rng, side, yaw)
        pixels = (points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]) @ K.T
        rays = o3d.t.geometry.RaycastingScene.create_rays_pinhole(
            intrinsic_matrix=o3d.core.Tensor(K),
            extrinsic_matrix=o3d.core.Tensor(cam_from_world),
            width_px=side,
            height_px=side,
        )
        rgba = self._shade(rays, rng, side)
        eye = -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]
        towards = points - eye
        sight = np.concatenate([np.broadcast_to(eye, towards.shape), towards], axis=1)
        share = self.scene.cast_rays(o3d.core.Tensor(sight.astype(np.float32)))["t_hit"].numpy()
        visible = (1.0 - share) * np.linalg.norm(towards, axis=1) < HIDING_M
        return TrainingView(rgba, pixels[:, :2] / pixels[:, 2:], visible, _facing(points, eye))

    def _shade(self, rays: o3d.core.Tensor, rng: Rng, side: int) -> np.ndarray:
        """Cast rays and light the hits: rgba (side, side, 4) uint8."""
        cast = self.scene.cast_rays(rays)
        distance = cast["t_hit"].numpy()
        hit = np.isfinite(distance)
        face = self.faces[cast["primitive_ids"].numpy()[hit]]
        bary = cast["primitive_uvs"].numpy()[hit]
        weights = np.stack([1 - bary.sum(1), bary[:, 0], bary[:, 1]], axis=1)[..., None]
        albedo = (self.head.colors[face] * weights).sum(1)
        normals = (self.head.normals[face] * weights).sum(1)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
        rays_hit = rays.numpy()[hit]
        towards = -rays_hit[:, 3:] / np.linalg.norm(rays_hit[:, 3:], axis=1, keepdims=True)
        points = rays_hit[:, :3] + rays_hit[:, 3:] * distance[hit][:, None]
        light = self._light(points, normals, towards, rng)
        image = np.zeros((side, side, 4), np.uint8)
        shaded = np.clip(albedo * light[0] + light[1], 0, 1) ** rng.uniform(0.7, 1.4)
        image[hit, :3] = (255 * shaded).astype(np.uint8)
        image[hit, 3] = 255
        return image

    def _light(
        self, points: np.ndarray, normals: np.ndarray, towards: np.ndarray, rng: Rng
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw ambient light and one to three lamps: diffuse and specular light (N, 3) each."""
        sky = 0.5 + 0.5 * normals @ _unit(rng.normal(size=3))
        diffuse = rng.uniform(0.1, 0.8) * (0.6 + 0.4 * sky[:, None]) * rng.uniform(0.8, 1.0, 3)
        specular = np.zeros_like(diffuse)
        for lamp in range(rng.integers(1, 4)):
            direction = _unit(rng.normal(size=3) + towards.mean(0) * rng.uniform(0.0, 2.0))
            color = rng.uniform(0.2, 1.0) * rng.uniform(0.75, 1.0, 3)
            cosine = np.clip(normals @ direction, 0, None)
            if lamp == 0 and rng.random() < 0.35:
                shadow = np.concatenate(
                    [points + 1e-3 * normals, np.broadcast_to(direction, points.shape)], axis=1
                )
                blocked = self.scene.test_occlusions(o3d.core.Tensor(shadow.astype(np.float32)))
                cosine = cosine * np.where(blocked.numpy(), rng.uniform(0, 0.6), 1.0)
            half = _unit(direction + towards)
            shine = np.clip((normals * half).sum(1), 0, None) ** rng.uniform(8, 60)
            diffuse = diffuse + cosine[:, None] * color
            specular = specular + self.head.gloss * (shine * (cosine > 0))[:, None] * color
        return diffuse, specular


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-9)


def _facing(points: np.ndarray, eye: np.ndarray) -> float:
    """Return the cosine between the face's forward direction and that to the camera centre."""
    across = points[45] - points[36]
    down = points[8] - points[27]
    forward = _unit(np.cross(down, across))
    # Right eye to left eye is +x, brow to chin is -y: (-y) x (+x) = +z.
    return float(forward @ _unit(eye - points[30]))


def _random_camera(
    points: np.ndarray, rng: Rng, side: int, yaw: float
) -> tuple[np.ndarray, np.ndarray]:
    """K (3,3) and cam_from_world (4,4) that frame the whole head, landmarks (68, 3) given."""
    pitch = np.clip(rng.normal() * 0.28, -0.8, 0.8)
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    target = points.mean(0) + np.array([0.0, 0.02, -0.06]) + rng.normal(size=3) * 0.008
    distance = np.exp(rng.uniform(np.log(0.45), np.log(2.0)))
    right = _unit(np.cross(np.array([0.0, 1.0, 0.0]), forward))
    rotation = np.stack([right, -np.cross(forward, right), -forward])
    roll = rng.normal() * 0.12
    turn = np.array(
        [[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1.0]]
    )
    rotation = turn @ rotation
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = rotation
    cam_from_world[:3, 3] = -rotation @ (target + distance * forward)
    focal = side * distance / FRAME_SIDE_M * rng.uniform(0.85, 1.15)
    return np.array([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1.0]]), cam_from_world


SIDE = 192
FILE_VIEWS = 300
# Each head is seen from every fifth of the range in which a face can be made out, and from behind.
FACE_YAW = np.radians(100.0)
VIEWS_PER_HEAD = 6
_ARRAYS = {"rgba": np.uint8, "points": np.float32, "visible": np.bool_, "facing": np.float32}


@dataclass(frozen=True)
class ViewSet:
    """Rendered views.

    Attributes:
        rgba: (N, S, S, 4) uint8, black where empty.
        points: (N, 68, 2) pixels, corner origin.
        visible: (N, 68) bool, landmarks that the head does not hide.
        facing: (N,) cosine between the face's forward direction and the direction to the camera.
    """

    rgba: np.ndarray
    points: np.ndarray
    visible: np.ndarray
    facing: np.ndarray


def view_file(folder: Path, model_name: str, number: int, seed: int) -> Path:
    """Return the path of one file of views."""
    return folder / f"{model_name}-{seed}-{number:03d}.npz"


def draw_yaws(rng: np.random.Generator) -> np.ndarray:
    """Yaws (VIEWS_PER_HEAD,) of one head's views, radians: even in front, the last from behind."""
    strata = VIEWS_PER_HEAD - 1
    front = ((np.arange(strata) + rng.random(strata)) * 2 / strata - 1) * FACE_YAW
    return np.append(front, rng.uniform(FACE_YAW, 2 * np.pi - FACE_YAW))


def draw_views(model: HeadModel, count: int, rng: np.random.Generator) -> list[TrainingView]:
    """Render `count` views of random heads."""
    views: list[TrainingView] = []
    while len(views) < count:
        scene = HeadScene(model, random_head(model, rng))
        yaws = draw_yaws(rng)[: count - len(views)]
        views += [scene.render(rng, SIDE, float(yaw)) for yaw in yaws]
    return views


def stack_views(views: list[TrainingView]) -> ViewSet:
    """Stack rendered views into one set."""
    return ViewSet(
        **{
            name: np.array([getattr(view, name) for view in views], dtype)
            for name, dtype in _ARRAYS.items()
        }
    )


def make_views(folder: Path, model: HeadModel, number: int, seed: int) -> Path:
    """Render one file of `FILE_VIEWS` views, unless it is there already."""
    path = view_file(folder, model.name, number, seed)
    if path.exists():
        return path
    rng = np.random.default_rng([seed, number, *model.name.encode()])
    views = stack_views(draw_views(model, FILE_VIEWS, rng))
    folder.mkdir(parents=True, exist_ok=True)
    # Two processes that happen to render the same file write the same bytes.
    part = path.with_suffix(f".{os.getpid()}.part")
    with part.open("wb") as file:
        np.savez(file, **vars(views))
    part.rename(path)
    return path


def read_views(path: Path) -> ViewSet:
    """Read a file of views."""
    with np.load(path, allow_pickle=False) as data:
        return ViewSet(**{name: data[name] for name in _ARRAYS})
