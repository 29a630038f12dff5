"""Training crops for the landmark network: views on random backgrounds, spoiled as cameras do."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from express50.adapters import affine_to_opencv
from express50.landmarks.network import CROP
from express50.landmarks.training_set import ViewSet

CROP_MARGIN = 1.55
# Partner of each iBUG-68 point in the mirror image.
MIRROR = np.array(
    [*range(16, -1, -1), *range(26, 16, -1), 27, 28, 29, 30, 35, 34, 33, 32, 31,
     45, 44, 43, 42, 47, 46, 39, 38, 37, 36, 41, 40,
     54, 53, 52, 51, 50, 49, 48, 59, 58, 57, 56, 55, 64, 63, 62, 61, 60, 67, 66, 65]
)  # fmt: skip
Rng = np.random.Generator


@dataclass(frozen=True)
class Crop:
    """A training crop: image (128, 128, 3) uint8, points (68, 2), score target, point weight."""

    image: np.ndarray
    points: np.ndarray
    score: float
    weight: float


def face_box(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (2,) and side of the square that the detector crops about landmarks (68, 2)."""
    low, high = points.min(0), points.max(0)
    return 0.5 * (low + high), CROP_MARGIN * float((high - low).max())


def random_crop(views: ViewSet, index: int, backgrounds: np.ndarray, rng: Rng) -> Crop:
    """Draw one training crop of a view."""
    rgba, points = views.rgba[index], views.points[index].astype(np.float64)
    centre, side = face_box(points)
    empty = rng.random() < 0.08
    if rng.random() < 0.8:
        side *= np.exp(rng.uniform(-0.18, 0.25))
        centre = centre + rng.normal(size=2) * 0.05 * side
    else:
        side *= np.exp(rng.uniform(0.0, 1.15))
        centre = centre + rng.uniform(-0.3, 0.3, 2) * side * (1 - CROP_MARGIN / 3)
    matrix = _crop_matrix(centre, side, rng.normal() * 0.2, bool(rng.random() < 0.5))
    image = _composite(rgba, matrix, _background(backgrounds, rng), empty, rng)
    points = points @ matrix[:, :2].T + matrix[:, 2]
    if np.linalg.det(matrix[:, :2]) < 0:
        points = points[MIRROR]
    facing = float(views.facing[index])
    score = 0.0 if empty else float(np.clip((facing + 0.15) / 0.3, 0.0, 1.0))
    weight = 0.0 if empty else float(np.clip((facing + 0.3) / 0.4, 0.0, 1.0))
    return Crop(_spoil(image, rng), points.astype(np.float32), score, weight)


def _crop_matrix(centre: np.ndarray, side: float, angle: float, mirror: bool) -> np.ndarray:
    """Affine (2, 3) from view pixels to crop pixels, corner origin."""
    scale = CROP / side
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    if mirror:
        turn = np.diag([-1.0, 1.0]) @ turn
    return np.concatenate([turn, (CROP / 2 - turn @ centre)[:, None]], axis=1)


def _composite(
    rgba: np.ndarray, matrix: np.ndarray, background: np.ndarray, empty: bool, rng: Rng
) -> np.ndarray:
    """Warp a view into the crop over a background."""
    if empty:
        return background
    scale = np.sqrt(abs(np.linalg.det(matrix[:, :2])))
    source = rgba.astype(np.float32)
    source[..., :3] *= source[..., 3:] / 255.0
    if scale < 0.8:
        source = cv2.GaussianBlur(source, (0, 0), 0.45 / scale)
    shape = (CROP, CROP)
    warped = cv2.warpAffine(source, affine_to_opencv(matrix), shape, flags=cv2.INTER_LINEAR)
    return warped[..., :3] + background * (1 - warped[..., 3:] / 255.0)


def _spoil(image: np.ndarray, rng: Rng) -> np.ndarray:
    """Occlusion, colour gain, contrast, blur, noise, low resolution and JPEG; uint8 out."""
    for _ in range(rng.integers(1, 3) if rng.random() < 0.25 else 0):
        _occlude(image, rng)
    image = image * rng.uniform(0.75, 1.25, 3).astype(np.float32) * rng.uniform(0.6, 1.3)
    if rng.random() < 0.15:
        image = np.repeat(image.mean(2, keepdims=True), 3, axis=2)
    image = np.clip(image + rng.uniform(-20, 30), 0, 255).astype(np.float32)
    if rng.random() < 0.4:
        image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.8))
    if rng.random() < 0.2:
        small = int(rng.uniform(0.35, 0.8) * CROP)
        image = cv2.resize(image, (small, small), interpolation=cv2.INTER_AREA)
        image = cv2.resize(image, (CROP, CROP), interpolation=cv2.INTER_LINEAR)
    if rng.random() < 0.5:
        image = image + rng.normal(size=image.shape).astype(np.float32) * rng.uniform(1, 14)
    image = np.clip(image, 0, 255).astype(np.uint8)
    if rng.random() < 0.35:
        quality = int(rng.integers(25, 95))
        coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        image = cv2.imdecode(coded, cv2.IMREAD_COLOR)
    return image


def _occlude(image: np.ndarray, rng: Rng) -> None:
    """Paint one ellipse or bar over the crop, in place."""
    color = tuple(float(value) for value in rng.uniform(0, 255, 3))
    centre = tuple(int(value) for value in rng.uniform(0, CROP, 2))
    if rng.random() < 0.6:
        axes = tuple(int(value) for value in rng.uniform(4, 28, 2))
        cv2.ellipse(image, centre, axes, rng.uniform(0, 180), 0, 360, color, -1, cv2.LINE_AA)
    else:
        end = tuple(int(value) for value in rng.uniform(0, CROP, 2))
        cv2.line(image, centre, end, color, int(rng.integers(1, 10)), cv2.LINE_AA)


def _background(backgrounds: np.ndarray, rng: Rng) -> np.ndarray:
    """A random piece of the pool (N, 2 CROP, 2 CROP, 3), float32 in 0..255."""
    pool = backgrounds[rng.integers(len(backgrounds))]
    x, y = rng.integers(0, CROP, 2)
    return np.ascontiguousarray(pool[y : y + CROP, x : x + CROP]).astype(np.float32)


def make_backgrounds(count: int, rng: Rng) -> np.ndarray:
    """Backgrounds (count, 2 CROP, 2 CROP, 3) uint8: noise at many scales, gradients, strokes."""
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
            color = tuple(float(value) for value in rng.uniform(0, 255, 3))
            start, end = (tuple(int(v) for v in rng.uniform(0, side, 2)) for _ in range(2))
            cv2.line(image, start, end, color, int(rng.integers(1, 8)), cv2.LINE_AA)
        for _ in range(rng.integers(0, 6)):
            color = tuple(float(value) for value in rng.uniform(0, 255, 3))
            centre = tuple(int(value) for value in rng.uniform(0, side, 2))
            axes = tuple(int(value) for value in rng.uniform(5, 70, 2))
            cv2.ellipse(image, centre, axes, rng.uniform(0, 180), 0, 360, color, -1, cv2.LINE_AA)
        if rng.random() < 0.5:
            image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.5, 6))
        pool[index] = np.clip(image, 0, 255).astype(np.uint8)
    return pool
