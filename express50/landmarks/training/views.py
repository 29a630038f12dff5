"""Cut training crops of rendered heads on random backgrounds, degraded as by cameras.

A file of views is made once; it depends on the seed, the head model and its number alone.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from express50.geometry.conventions import affine_to_opencv
from express50.geometry.transforms import scale_of, transform_points
from express50.head.model import HeadModel
from express50.landmarks.network import (
    CROP,
    CROP_MARGIN,
    MIRROR,
    MIRROR_WITH_OUTLINE,
    POINTS,
    face_box,
)
from express50.landmarks.training.random_heads import random_head
from express50.landmarks.training.scene import HeadScene, TrainingView

Rng = np.random.Generator
Record = TypeVar("Record")
SIDE = 192
FILE_VIEWS = 300
# Each head is seen once from each fifth of the yaws at which its face is visible, and from behind.
FACE_YAW = np.radians(100.0)
VIEWS_PER_HEAD = 6


def draw_yaws(rng: np.random.Generator) -> np.ndarray:
    """Draw the yaws (VIEWS_PER_HEAD,) of a head, radians: stratified in front, the last behind."""
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
    """Read one file of `FILE_VIEWS` views; render it if it does not exist."""
    rng = np.random.default_rng([seed, number, *model.name.encode()])
    # The name changes with the head and its landmarks.
    parts = (model.template, model.landmark_faces, model.landmark_bary)
    made_of = b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
    digest = hashlib.sha256(made_of).hexdigest()[:8]
    path = folder / f"{model.name}-{digest}-{seed}-{number:03d}.npz"
    return made_once(path, TrainingView, lambda: draw_views(model, FILE_VIEWS, rng))


def made_once(path: Path, kind: type[Record], make: Callable[[], list[Record]]) -> list[Record]:
    """Read a file of records, dataclasses of arrays; make it if it does not exist."""
    names = kind.__annotations__
    if not path.exists():
        records = make()
        arrays: Any = {name: np.stack([getattr(one, name) for one in records]) for name in names}
        path.parent.mkdir(parents=True, exist_ok=True)
        # If two processes make the same file, they write the same bytes.
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
    # (68 + 17, 2) pixels of a crop of `CROP` pixels, whatever the image's size
    points: np.ndarray
    visible: np.ndarray  # (68,) float32, 1 where neither the head nor anything else hides the point
    score: float  # target of the face score
    weight: float  # how much the points count; 0 for backs of heads


def random_crop(
    view: TrainingView, backgrounds: np.ndarray, rng: Rng, size: int = CROP
) -> TrainingCrop:
    """Draw one training crop of a view, (size, size) pixels."""
    points = view.points.astype(np.float64)
    empty = rng.random() < 0.08
    matrix = _random_placement(points[:POINTS], rng)
    points = transform_points(matrix, points)
    visible = view.visible
    if np.linalg.det(matrix[:, :2]) < 0:
        points, visible = points[MIRROR_WITH_OUTLINE], visible[MIRROR]
    pool = backgrounds[rng.integers(len(backgrounds))]
    x, y = rng.integers(0, CROP, 2)
    image = pool[y : y + CROP, x : x + CROP].copy()
    if size != CROP:
        image = cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)
    scaled = points[:POINTS] * (size / CROP)
    if not empty:
        _shoulders(image, scaled, rng)
        image = composite(view.rgba, matrix * (size / CROP), image)
    covered = np.zeros(image.shape[:2], np.uint8)
    if rng.random() < 0.25:
        _hair_locks(image, covered, scaled, rng)
    if rng.random() < 0.1:
        _fingers(image, covered, scaled, rng)
    elif rng.random() < 0.2:
        for _ in range(rng.integers(1, 3)):
            _occlude(image, covered, rng)
    facing = float(view.facing)
    score = 0.0 if empty else float(np.clip((facing + 0.15) / 0.3, 0.0, 1.0))
    weight = 0.0 if empty else float(np.clip((facing + 0.3) / 0.4, 0.0, 1.0))
    column, row = np.floor(scaled).astype(int).T
    shown = (column >= 0) & (row >= 0) & (column < size) & (row < size)
    shown[shown] = covered[row[shown], column[shown]] == 0
    visible = (visible & shown).astype(np.float32)
    return TrainingCrop(degrade(image, rng), points.astype(np.float32), visible, score, weight)


def _random_placement(points: np.ndarray, rng: Rng) -> np.ndarray:
    """Draw the map (2, 3) from pixels of a view with landmarks (68, 2) to those of a crop."""
    centre, side = face_box(points)
    if rng.random() < 0.8:
        side *= np.exp(rng.uniform(-0.18, 0.25))
        centre = centre + rng.normal(size=2) * 0.05 * side
    else:
        side *= np.exp(rng.uniform(0.0, 1.15))
        centre = centre + rng.uniform(-0.3, 0.3, 2) * side * (1 - CROP_MARGIN / 3)
    angle = rng.normal() * 0.2
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turn = CROP / side * turn
    if rng.random() < 0.5:
        turn = np.diag([-1.0, 1.0]) @ turn
    return np.concatenate([turn, (CROP / 2 - turn @ centre)[:, None]], axis=1)


def composite(rgba: np.ndarray, matrix: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Warp a view, black where empty, into the crop over a background; return it as uint8."""
    scale = scale_of(matrix)
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
    """Paint a body of one colour below the chin, in place, in half of the draws."""
    if rng.random() < 0.5:
        return
    height, down = _size_and_down(points)
    middle = points.mean(0) + down * height * rng.uniform(1.4, 1.9)
    axes = (int(height * rng.uniform(0.9, 1.6)), int(height * rng.uniform(0.6, 0.9)))
    angle = float(np.degrees(np.arctan2(down[1], down[0])) - 90)
    color = _random_color(rng)
    cv2.ellipse(image, _whole(middle), axes, angle, 0, 360, color, -1, cv2.LINE_AA)


def _hair_locks(image: np.ndarray, mask: np.ndarray, points: np.ndarray, rng: Rng) -> None:
    """Paint strands of one colour over a part of the face, in place."""
    height, down = _size_and_down(points)
    across = np.array([down[1], -down[0]])
    count = int(rng.integers(8, 120))
    # A fringe, or hair beside the face.
    side = rng.uniform(-0.6, 0.6) if rng.random() < 0.5 else rng.choice([-0.6, 0.6])
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


def _fingers(image: np.ndarray, mask: np.ndarray, points: np.ndarray, rng: Rng) -> None:
    """Paint two to five fingers of about the face's colour over a part of it, in place."""
    height, _ = _size_and_down(points)
    column, row = np.clip(points[rng.choice([2, 14, 30, 33, 27])], 0, len(image) - 1).astype(int)
    skin = image[row, column] * rng.uniform(0.7, 1.2)
    angle, width = rng.uniform(0, 2 * np.pi), max(2, int(height * rng.uniform(0.06, 0.11)))
    along = np.array([np.cos(angle), np.sin(angle)])
    tip = points[rng.integers(len(points))] + rng.normal(size=2) * 0.1 * height
    for finger in range(rng.integers(2, 6)):
        shift = np.array([-along[1], along[0]]) * 1.05 * width * finger
        start = tip + shift + along * height * rng.uniform(-0.08, 0.08)
        end = start + along * height * rng.uniform(0.5, 1.0)
        for color, thick in ((0.55 * skin, width), (skin, int(0.8 * width))):
            shade = tuple(float(value) for value in color)
            cv2.line(image, _whole(start), _whole(end), shade, max(1, thick), cv2.LINE_AA)
        cv2.line(mask, _whole(start), _whole(end), 1, width)


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


def degrade(image: np.ndarray, rng: Rng) -> np.ndarray:
    """Apply random gain, white balance, gamma, haze, blur, low resolution, noise and JPEG."""
    ramp = np.arange(256)[:, None] / 255.0
    curve = (ramp * rng.uniform(0.8, 1.25, 3)) ** rng.uniform(0.65, 1.5) * rng.uniform(0.6, 1.3)
    table = np.clip(255 * curve + rng.uniform(-20, 30), 0, 255).astype(np.uint8)
    image = cv2.LUT(image, table[None])
    if rng.random() < 0.15:
        image = cv2.merge([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)] * 3)
    size = full = len(image)
    if rng.random() < 0.45:
        # A small or distant face: what follows applies to its few pixels.
        size = int(full * rng.uniform(0.22, 0.9))
        image = cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)
    if rng.random() < 0.35:
        image = cv2.GaussianBlur(image, (0, 0), size / CROP * rng.uniform(0.4, 1.8))
    if rng.random() < 0.1:
        length = size / CROP * rng.uniform(2, 8)  # of a straight motion, pixels
        side = 2 * int(np.ceil(length / 2)) + 1
        kernel, angle = np.zeros((side, side), np.float32), rng.uniform(0, np.pi)
        step = 0.5 * length * np.array([np.cos(angle), np.sin(angle)])
        ends = (_whole(np.round(side // 2 + sign * step)) for sign in (-1, 1))
        cv2.line(kernel, *ends, 1.0, 1, cv2.LINE_AA)
        image = cv2.filter2D(image, -1, kernel / kernel.sum())
    if rng.random() < 0.5:
        noise = rng.standard_normal(image.shape, np.float32) * np.float32(rng.uniform(1, 14))
        image = np.clip(image + noise, 0, 255).astype(np.uint8)
    if rng.random() < 0.4:
        quality = int(rng.integers(25, 95))
        coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        image = cv2.imdecode(coded, cv2.IMREAD_COLOR)
    if size != full:
        image = cv2.resize(image, (full, full), interpolation=cv2.INTER_LINEAR)
    return image


def make_backgrounds(count: int, rng: Rng) -> np.ndarray:
    """Draw backgrounds (count, 2 CROP, 2 CROP, 3) uint8: noise at many scales, lines, ellipses."""
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
