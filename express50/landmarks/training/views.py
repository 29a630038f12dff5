"""Render training crops of random heads on random backgrounds, spoiled as cameras do.

A view has a picture, landmarks, and which of them the head hides. A file of views is made once; it
depends on the seed, the head model and its number alone.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import open3d as o3d

from express50.geometry.conventions import affine_to_opencv
from express50.geometry.raycast import join_rays, mesh_scene
from express50.geometry.transforms import make_transform
from express50.head.model import HeadModel
from express50.landmarks.network import CROP, CROP_MARGIN, MIRROR, face_box
from express50.landmarks.training.random_heads import RandomHead, random_head

FRAME_SIDE_M = 0.38
# A landmark counts as seen if nothing lies further than this in front of it.
HIDING_M = 0.005
Rng = np.random.Generator
Record = TypeVar("Record")


@dataclass(frozen=True)
class TrainingView:
    """A rendered view."""

    rgba: np.ndarray  # (S, S, 4) uint8, black where empty
    points: np.ndarray  # (68, 2) float32 pixels, corner origin
    visible: np.ndarray  # (68,) bool, nothing of the head is before the landmark
    facing: np.float32  # cosine between the ways that the face looks and to the camera


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
        share = self.scene.cast_rays(join_rays(eye, towards))["t_hit"].numpy()
        visible = (1.0 - share) * np.linalg.norm(towards, axis=1) < HIDING_M
        # Right eye to left eye is +x, brow to chin is -y: (-y) x (+x) = +z.
        forward = unit(np.cross(points[8] - points[27], points[45] - points[36]))
        facing = np.float32(forward @ unit(eye - points[30]))
        pixels = (pixels[:, :2] / pixels[:, 2:]).astype(np.float32)
        return TrainingView(rgba, pixels, visible, facing)

    def _shade(self, rays: o3d.core.Tensor, rng: Rng, side: int) -> np.ndarray:
        """Cast rays and light the hits: rgba (side, side, 4) uint8."""
        cast = self.scene.cast_rays(rays)
        distance = cast["t_hit"].numpy()
        hit = np.isfinite(distance)
        face = self.faces[cast["primitive_ids"].numpy()[hit]]
        bary = cast["primitive_uvs"].numpy()[hit]
        weights = np.column_stack([1 - bary.sum(1), bary])[..., None]
        albedo = (self.head.colors[face] * weights).sum(1)
        normals = unit((self.head.normals[face] * weights).sum(1))
        start, ahead = np.split(rays.numpy()[hit], 2, axis=1)
        points = start + ahead * distance[hit][:, None]
        light = self._light(points, normals, -unit(ahead), rng)
        image = np.zeros((side, side, 4), np.uint8)
        shaded = np.clip(albedo * light[0] + light[1], 0, 1) ** rng.uniform(0.7, 1.4)
        image[hit, :3] = (255 * shaded).astype(np.uint8)
        image[hit, 3] = 255
        return image

    def _light(
        self, points: np.ndarray, normals: np.ndarray, towards: np.ndarray, rng: Rng
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw ambient light and one to three lamps: diffuse and specular light (N, 3) each."""
        sky = 0.5 + 0.5 * normals @ unit(rng.normal(size=3))
        diffuse = rng.uniform(0.1, 0.8) * (0.6 + 0.4 * sky[:, None]) * rng.uniform(0.8, 1.0, 3)
        specular = np.zeros_like(diffuse)
        for lamp in range(rng.integers(1, 4)):
            direction = unit(rng.normal(size=3) + towards.mean(0) * rng.uniform(0.0, 2.0))
            color = rng.uniform(0.2, 1.0) * rng.uniform(0.75, 1.0, 3)
            cosine = np.clip(normals @ direction, 0, None)
            if lamp == 0 and rng.random() < 0.35:
                shadow = join_rays(points + 1e-3 * normals, direction)
                blocked = self.scene.test_occlusions(shadow)
                cosine = cosine * np.where(blocked.numpy(), rng.uniform(0, 0.6), 1.0)
            half = unit(direction + towards)
            shine = np.clip((normals * half).sum(1), 0, None) ** rng.uniform(8, 60)
            diffuse = diffuse + cosine[:, None] * color
            specular = specular + self.head.gloss * (shine * (cosine > 0))[:, None] * color
        return diffuse, specular


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scale vectors (..., 3) to length 1; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def _random_camera(
    points: np.ndarray, rng: Rng, side: int, yaw: float
) -> tuple[np.ndarray, np.ndarray]:
    """Draw K (3,3) and cam_from_world (4,4) that frame the whole head, landmarks (68, 3) given."""
    pitch = np.clip(rng.normal() * 0.28, -0.8, 0.8)
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    target = points.mean(0) + np.array([0.0, 0.02, -0.06]) + rng.normal(size=3) * 0.008
    distance = np.exp(rng.uniform(np.log(0.45), np.log(2.0)))
    right = unit(np.cross(np.array([0.0, 1.0, 0.0]), forward))
    rotation = np.stack([right, -np.cross(forward, right), -forward])
    roll = rng.normal() * 0.12
    c, s = np.cos(roll), np.sin(roll)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) @ rotation
    cam_from_world = make_transform(rotation, -rotation @ (target + distance * forward))
    focal = side * distance / FRAME_SIDE_M * rng.uniform(0.85, 1.15)
    return np.array([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1.0]]), cam_from_world


SIDE = 192
FILE_VIEWS = 300
# Each head is seen from every fifth of the range in which a face can be made out, and from behind.
FACE_YAW = np.radians(100.0)
VIEWS_PER_HEAD = 6


def draw_yaws(rng: np.random.Generator) -> np.ndarray:
    """Draw yaws (VIEWS_PER_HEAD,) of a head, radians: even in front, the last from behind."""
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


def open_views(folder: Path, model: HeadModel, number: int, seed: int) -> list[TrainingView]:
    """Read one file of `FILE_VIEWS` views, which is rendered if it is not there yet."""
    rng = np.random.default_rng([seed, number, *model.name.encode()])
    path = folder / f"{model.name}-{seed}-{number:03d}.npz"
    return made_once(path, TrainingView, lambda: draw_views(model, FILE_VIEWS, rng))


def made_once(path: Path, kind: type[Record], make: Callable[[], list[Record]]) -> list[Record]:
    """Read a file of records, dataclasses of arrays, which are made if it is not there yet."""
    names = kind.__annotations__
    if not path.exists():
        records = make()
        arrays: Any = {name: np.stack([getattr(one, name) for one in records]) for name in names}
        path.parent.mkdir(parents=True, exist_ok=True)
        # Two processes that happen to make the same file write the same bytes.
        part = path.with_suffix(f".{os.getpid()}.part")
        with part.open("wb") as file:
            np.savez(file, **arrays)
        part.rename(path)
    with np.load(path, allow_pickle=False) as data:
        return [kind(*row) for row in zip(*(data[name] for name in names), strict=True)]


@dataclass(frozen=True)
class TrainingCrop:
    """A training crop."""

    image: np.ndarray  # (size, size, 3) uint8
    points: np.ndarray  # (68, 2) in pixels of a crop of `CROP` pixels, whatever the image's size
    visible: np.ndarray  # (68,) float32, 1 where neither the head nor anything else hides the point
    score: float  # target of the face score
    weight: float  # how much the points count; 0 for backs of heads


def random_crop(
    view: TrainingView, backgrounds: np.ndarray, rng: Rng, size: int = CROP
) -> TrainingCrop:
    """Draw one training crop of a view, (size, size) pixels."""
    points = view.points.astype(np.float64)
    centre, side = face_box(points)
    empty = rng.random() < 0.06
    if rng.random() < 0.8:
        side *= np.exp(rng.uniform(-0.18, 0.25))
        centre = centre + rng.normal(size=2) * 0.05 * side
    else:
        side *= np.exp(rng.uniform(0.0, 1.15))
        centre = centre + rng.uniform(-0.3, 0.3, 2) * side * (1 - CROP_MARGIN / 3)
    angle = rng.normal() * 0.2
    # From view pixels to crop pixels, corner origin.
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turn = CROP / side * turn
    if rng.random() < 0.5:
        turn = np.diag([-1.0, 1.0]) @ turn
    matrix = np.concatenate([turn, (CROP / 2 - turn @ centre)[:, None]], axis=1)
    points = points @ matrix[:, :2].T + matrix[:, 2]
    visible = view.visible
    if np.linalg.det(matrix[:, :2]) < 0:
        points, visible = points[MIRROR], visible[MIRROR]
    pool = backgrounds[rng.integers(len(backgrounds))]
    x, y = rng.integers(0, CROP, 2)
    image = pool[y : y + CROP, x : x + CROP].copy()
    if size != CROP:
        image = cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)
    if not empty:
        _shoulders(image, points * (size / CROP), rng)
        image = _composite(view.rgba, matrix * (size / CROP), image)
    covered = np.zeros(image.shape[:2], np.uint8)
    kind = rng.random()
    if kind < 0.2:
        _hair_locks(image, covered, points * (size / CROP), rng)
    elif kind < 0.42:
        for _ in range(rng.integers(1, 3)):
            _occlude(image, covered, rng)
    facing = float(view.facing)
    score = 0.0 if empty else float(np.clip((facing + 0.15) / 0.3, 0.0, 1.0))
    weight = 0.0 if empty else float(np.clip((facing + 0.3) / 0.4, 0.0, 1.0))
    column, row = np.floor(points * (size / CROP)).astype(int).T
    shown = (column >= 0) & (row >= 0) & (column < size) & (row < size)
    shown[shown] = covered[row[shown], column[shown]] == 0
    visible = (visible & shown).astype(np.float32)
    return TrainingCrop(_spoil(image, rng), points.astype(np.float32), visible, score, weight)


def _composite(rgba: np.ndarray, matrix: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Warp a view (black where empty) into the crop over a background; uint8."""
    scale = float(np.sqrt(abs(np.linalg.det(matrix[:, :2]))))
    if scale < 0.8:
        rgba = cv2.GaussianBlur(rgba, (0, 0), 0.45 / scale)
    size = background.shape[:2]
    warped = cv2.warpAffine(rgba, affine_to_opencv(matrix), size, flags=cv2.INTER_LINEAR)
    through = cv2.merge([255 - warped[..., 3]] * 3)
    return cv2.add(warped[..., :3], cv2.multiply(background, through, scale=1 / 255.0))


def _size_and_down(points: np.ndarray) -> tuple[float, np.ndarray]:
    down = points[8] - points[27]
    return float(np.ptp(points, axis=0).max()), down / max(float(np.linalg.norm(down)), 1e-6)


def _random_color(rng: Rng) -> tuple[float, ...]:
    return tuple(float(value) for value in rng.uniform(0, 255, 3))


def _shoulders(image: np.ndarray, points: np.ndarray, rng: Rng) -> None:
    """Paint a body of one colour below the chin, in place: not all below a head is backdrop."""
    if rng.random() < 0.5:
        return
    height, down = _size_and_down(points)
    middle = points.mean(0) + down * height * rng.uniform(1.4, 1.9)
    axes = (int(height * rng.uniform(0.9, 1.6)), int(height * rng.uniform(0.6, 0.9)))
    angle = float(np.degrees(np.arctan2(down[1], down[0])) - 90)
    color = _random_color(rng)
    cv2.ellipse(image, _whole(middle), axes, angle, 0, 360, color, -1, cv2.LINE_AA)


def _hair_locks(image: np.ndarray, mask: np.ndarray, points: np.ndarray, rng: Rng) -> None:
    """Paint strands of one colour that fall over a part of the face, in place."""
    height, down = _size_and_down(points)
    across = np.array([down[1], -down[0]])
    count, side = int(rng.integers(8, 50)), rng.uniform(-0.6, 0.6)
    begin = points[27] - height * down * rng.uniform(0.3, 0.7)
    start = begin + height * (side + rng.normal(size=(count, 1)) * 0.12) * across
    length = height * rng.uniform(0.2, 0.9) * rng.uniform(0.7, 1.2, (count, 1))
    sweep = height * (rng.normal() * 0.3 + rng.normal(size=(count, 1)) * 0.06)
    share = np.linspace(0, 1, 6)[:, None, None]
    strands = start + share * length * down + share**2 * sweep * across
    color = rng.uniform(0, 200) * np.array([1.0, rng.uniform(0.6, 1), rng.uniform(0.3, 1)])
    paths = np.ascontiguousarray(np.round(strands.transpose(1, 0, 2) * 8).astype(np.int32))
    for strand in paths:
        shade = tuple(float(value) for value in color * rng.uniform(0.6, 1.2))
        cv2.polylines(image, [strand], False, shade, 1, cv2.LINE_AA, 3)
        cv2.polylines(mask, [strand], False, 1, 1, cv2.LINE_8, 3)


def _occlude(image: np.ndarray, mask: np.ndarray, rng: Rng) -> None:
    """Paint one ellipse or bar over the crop, in place."""
    size = len(image)
    color = _random_color(rng)
    centre = _whole(rng.uniform(0, size, 2))
    if rng.random() < 0.6:
        axes, angle = _whole(size * rng.uniform(0.03, 0.22, 2)), rng.uniform(0, 180)
        cv2.ellipse(image, centre, axes, angle, 0, 360, color, -1, cv2.LINE_AA)
        cv2.ellipse(mask, centre, axes, angle, 0, 360, 1, -1)
    else:
        end, width = _whole(rng.uniform(0, size, 2)), max(1, int(size * rng.uniform(0.01, 0.08)))
        cv2.line(image, centre, end, color, width, cv2.LINE_AA)
        cv2.line(mask, centre, end, 1, width)


def _whole(values: np.ndarray) -> tuple[int, int]:
    return int(values[0]), int(values[1])


def _spoil(image: np.ndarray, rng: Rng) -> np.ndarray:
    """Apply gain, white balance, gamma, haze, blur, low resolution, noise and JPEG; uint8 out."""
    ramp = np.arange(256)[:, None] / 255.0
    curve = (ramp * rng.uniform(0.8, 1.25, 3)) ** rng.uniform(0.65, 1.5) * rng.uniform(0.6, 1.3)
    table = np.clip(255 * curve + rng.uniform(-20, 30), 0, 255).astype(np.uint8)
    image = cv2.LUT(image, table[None])
    if rng.random() < 0.15:
        image = cv2.merge([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)] * 3)
    size = len(image)
    if rng.random() < 0.4:
        image = cv2.GaussianBlur(image, (0, 0), size / CROP * rng.uniform(0.4, 1.8))
    if rng.random() < 0.2:
        small = int(rng.uniform(0.35, 0.8) * size)
        image = cv2.resize(image, (small, small), interpolation=cv2.INTER_AREA)
        image = cv2.resize(image, (size, size), interpolation=cv2.INTER_LINEAR)
    if rng.random() < 0.5:
        noise = rng.standard_normal(image.shape, np.float32) * np.float32(rng.uniform(1, 14))
        image = np.clip(image + noise, 0, 255).astype(np.uint8)
    if rng.random() < 0.35:
        quality = int(rng.integers(25, 95))
        coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        image = cv2.imdecode(coded, cv2.IMREAD_COLOR)
    return image


def make_backgrounds(count: int, rng: Rng) -> np.ndarray:
    """Draw backgrounds (count, 2 CROP, 2 CROP, 3) uint8: noise at many scales, strokes."""
    side = 2 * CROP
    pool = np.zeros((count, side, side, 3), np.uint8)
    for index in range(count):
        image = np.tile(rng.uniform(0, 255, 3), (side, side, 1)).astype(np.float32)
        for cells in (2, 5, 12, 30, 80):
            grid = rng.normal(size=(cells, cells, 3)).astype(np.float32)
            grid[..., 1:] = grid[..., :1] + (grid[..., 1:] - grid[..., :1]) * rng.uniform(0, 1)
            layer = cv2.resize(grid, (side, side), interpolation=cv2.INTER_CUBIC)
            image += layer * rng.uniform(0, 45) * (rng.random() < 0.5)
        for _ in range(rng.integers(0, 14)):
            color = _random_color(rng)
            start, end = (_whole(rng.uniform(0, side, 2)) for _ in range(2))
            cv2.line(image, start, end, color, int(rng.integers(1, 8)), cv2.LINE_AA)
        for _ in range(rng.integers(0, 6)):
            color = _random_color(rng)
            centre, axes = _whole(rng.uniform(0, side, 2)), _whole(rng.uniform(5, 70, 2))
            cv2.ellipse(image, centre, axes, rng.uniform(0, 180), 0, 360, color, -1, cv2.LINE_AA)
        if rng.random() < 0.5:
            image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.5, 6))
        pool[index] = np.clip(image, 0, 255).astype(np.uint8)
    return pool
