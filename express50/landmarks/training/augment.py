"""Training crops for the landmark network: views on random backgrounds, spoiled as cameras do."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from express50.geometry.conventions import affine_to_opencv
from express50.landmarks.network import CROP, CROP_MARGIN, MIRROR, face_box
from express50.landmarks.training.views import ViewSet

Rng = np.random.Generator


@dataclass(frozen=True)
class TrainingCrop:
    """A training crop.

    Attributes:
        image: (size, size, 3) uint8.
        points: (68, 2) in pixels of a crop of `CROP` pixels, whatever the image's size.
        visible: (68,) float32, 1 where neither the head nor anything else hides the point.
        score: target of the face score.
        weight: how much the points count; 0 for backs of heads.
    """

    image: np.ndarray
    points: np.ndarray
    visible: np.ndarray
    score: float
    weight: float


def random_crop(
    views: ViewSet, index: int, backgrounds: np.ndarray, rng: Rng, size: int = CROP
) -> TrainingCrop:
    """Draw one training crop of a view, (size, size) pixels."""
    points = views.points[index].astype(np.float64)
    centre, side = face_box(points)
    empty = rng.random() < 0.06
    if rng.random() < 0.8:
        side *= np.exp(rng.uniform(-0.18, 0.25))
        centre = centre + rng.normal(size=2) * 0.05 * side
    else:
        side *= np.exp(rng.uniform(0.0, 1.15))
        centre = centre + rng.uniform(-0.3, 0.3, 2) * side * (1 - CROP_MARGIN / 3)
    matrix = _crop_matrix(centre, side, rng.normal() * 0.2, bool(rng.random() < 0.5))
    points = points @ matrix[:, :2].T + matrix[:, 2]
    visible = views.visible[index]
    if np.linalg.det(matrix[:, :2]) < 0:
        points, visible = points[MIRROR], visible[MIRROR]
    image = _background(backgrounds, size, rng)
    if not empty:
        _shoulders(image, points * (size / CROP), rng)
        image = _composite(views.rgba[index], matrix * (size / CROP), image)
    covered = np.zeros(image.shape[:2], np.uint8)
    kind = rng.random()
    if kind < 0.2:
        _hair_locks(image, covered, points * (size / CROP), rng)
    elif kind < 0.42:
        for _ in range(rng.integers(1, 3)):
            _occlude(image, covered, rng)
    facing = float(views.facing[index])
    score = 0.0 if empty else float(np.clip((facing + 0.15) / 0.3, 0.0, 1.0))
    weight = 0.0 if empty else float(np.clip((facing + 0.3) / 0.4, 0.0, 1.0))
    column, row = np.floor(points * (size / CROP)).astype(int).T
    shown = (column >= 0) & (row >= 0) & (column < size) & (row < size)
    shown[shown] = covered[row[shown], column[shown]] == 0
    visible = (visible & shown).astype(np.float32)
    return TrainingCrop(_spoil(image, rng), points.astype(np.float32), visible, score, weight)


def _crop_matrix(centre: np.ndarray, side: float, angle: float, mirror: bool) -> np.ndarray:
    """Return affine (2, 3) from view pixels to crop pixels, corner origin."""
    scale = CROP / side
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    if mirror:
        turn = np.diag([-1.0, 1.0]) @ turn
    return np.concatenate([turn, (CROP / 2 - turn @ centre)[:, None]], axis=1)


def _composite(rgba: np.ndarray, matrix: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Warp a view (black where empty) into the crop over a background; uint8."""
    scale = float(np.sqrt(abs(np.linalg.det(matrix[:, :2]))))
    if scale < 0.8:
        rgba = cv2.GaussianBlur(rgba, (0, 0), 0.45 / scale)
    size = background.shape[:2]
    warped = cv2.warpAffine(rgba, affine_to_opencv(matrix), size, flags=cv2.INTER_LINEAR)
    through = cv2.merge([255 - warped[..., 3]] * 3)
    return cv2.add(warped[..., :3], cv2.multiply(background, through, scale=1 / 255.0))


def _shoulders(image: np.ndarray, points: np.ndarray, rng: Rng) -> None:
    """Paint a body of one colour below the chin, in place: not all below a head is backdrop."""
    if rng.random() < 0.5:
        return
    height = float(np.ptp(points, axis=0).max())
    down = points[8] - points[27]
    down = down / max(float(np.linalg.norm(down)), 1e-6)
    middle = points.mean(0) + down * height * rng.uniform(1.4, 1.9)
    axes = (int(height * rng.uniform(0.9, 1.6)), int(height * rng.uniform(0.6, 0.9)))
    angle = float(np.degrees(np.arctan2(down[1], down[0])) - 90)
    color = tuple(float(value) for value in rng.uniform(0, 255, 3))
    cv2.ellipse(image, _whole(middle), axes, angle, 0, 360, color, -1, cv2.LINE_AA)


def _hair_locks(image: np.ndarray, mask: np.ndarray, points: np.ndarray, rng: Rng) -> None:
    """Paint strands of one colour that fall over a part of the face, in place."""
    height = float(np.ptp(points, axis=0).max())
    down = points[8] - points[27]
    down = down / max(float(np.linalg.norm(down)), 1e-6)
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
    color = tuple(float(value) for value in rng.uniform(0, 255, 3))
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


def _background(backgrounds: np.ndarray, size: int, rng: Rng) -> np.ndarray:
    """Return a random piece (size, size, 3) of the pool (N, 2 CROP, 2 CROP, 3)."""
    pool = backgrounds[rng.integers(len(backgrounds))]
    x, y = rng.integers(0, CROP, 2)
    piece = pool[y : y + CROP, x : x + CROP]
    if size == CROP:
        return piece.copy()
    return cv2.resize(piece, (size, size), interpolation=cv2.INTER_AREA)


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
