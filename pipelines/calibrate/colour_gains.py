"""Colour gains of cameras against each other, per channel, from the board's white paper.

Matt paper reflects much the same light everywhere, so a camera's gain is the light it records of a
square, against what the others record at the same instant. Faces were tried instead and are worse:
their gloss moves with the camera by more than gains differ (docs/LOG.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse.csgraph import connected_components

from express50.files.images import LIGHT_OF_LEVEL
from express50.geometry.conventions import corner_to_opencv_pixels
from pipelines.calibrate.board import Board, opencv_board

LEAST_SHARED = 12
"""Squares that two cameras must see together to be compared."""


@dataclass(frozen=True)
class WhiteSquare:
    """Linear light (3,) of a white square of the board in one camera and frame."""

    camera: str
    frame: str
    square: int
    light: tuple[float, float, float]


@dataclass(frozen=True)
class GainFit:
    """Gains of cameras, in the order given.

    Attributes:
        gain: (C, 3), 1 where nothing ties a camera to the others.
        tied: (C,) bool, whether the gain was measured.
        before: median departure of light from its mean over cameras, percent; NaN if no patch was
            seen twice.
        after: the same with the gains divided out.
    """

    gain: np.ndarray
    tied: np.ndarray
    before: float
    after: float


@dataclass(frozen=True)
class ColourGains:
    """How cameras record the same light.

    Attributes:
        gain: linear light (3,) of a camera over the cameras' mean (geometric), of the cameras
            whose gain could be measured.
        before: median departure of a square's light from its mean over cameras, percent; None
            if no square was seen twice.
        after: the same with the gains divided out.
        squares: observations of white squares.
    """

    gain: dict[str, np.ndarray]
    before: float | None
    after: float | None
    squares: int


class WhiteCollector:
    """Collects the light of the board's white squares while its images are read."""

    def __init__(self, board: Board) -> None:
        self.squares = white_squares(board)
        self.whites: list[WhiteSquare] = []

    def look(
        self, camera: str, frame: str, image: np.ndarray, ids: np.ndarray, pixels: np.ndarray
    ) -> None:
        """Add one image (H, W, 3) uint8 with its corners: ids (N,), pixels (N, 2)."""
        light = white_light(image, ids, pixels, self.squares)
        self.whites += [WhiteSquare(camera, frame, n, value) for n, value in light.items()]

    def gains(self, cameras: Sequence[str]) -> ColourGains:
        """Measure the gains of some cameras."""
        number = {name: i for i, name in enumerate(cameras)}
        seen = [white for white in self.whites if white.camera in number]
        points = {key: i for i, key in enumerate(sorted({(w.frame, w.square) for w in seen}))}
        light = np.full((len(points), len(cameras), 3), np.nan)
        for white in seen:
            light[points[white.frame, white.square], number[white.camera]] = white.light
        fit = fit_gains(light)
        found = {name: fit.gain[i] for i, name in enumerate(cameras) if fit.tied[i]}
        if not found:
            return ColourGains({}, None, None, len(self.whites))
        return ColourGains(found, fit.before, fit.after, len(self.whites))


def white_squares(board: Board) -> dict[int, np.ndarray]:
    """Return the ids (4,) of the corners around each white square, by its marker's number."""
    side, across, down = board.square_length_m, board.squares_x - 1, board.squares_y - 1
    made = opencv_board(board)
    found = {}
    for number, marker in zip(made.getIds().ravel(), made.getObjPoints(), strict=True):
        column, row = np.floor(np.asarray(marker)[:, :2].mean(0) / side).astype(int)
        if 1 <= column < across and 1 <= row < down:
            first = (row - 1) * across + column - 1
            found[int(number)] = np.array([first, first + 1, first + 1 + across, first + across])
    return found


def white_light(
    image: np.ndarray, ids: np.ndarray, pixels: np.ndarray, squares: Mapping[int, np.ndarray]
) -> dict[int, tuple[float, float, float]]:
    """Measure the linear light (3,) of the squares' paper in an image (H, W, 3) uint8, by square.

    Args:
        image: sRGB, as recorded.
        ids: (N,) detected inner corners.
        pixels: (N, 2) where they are, first pixel's corner at the origin.
        squares: from :func:`white_squares`.
    """
    place = dict(zip(ids.tolist(), pixels, strict=True))
    found = {}
    for number, corners in squares.items():
        if all(int(corner) in place for corner in corners):
            light = _paper(image, np.array([place[int(corner)] for corner in corners]))
            if light is not None:
                found[number] = light
    return found


def _paper(image: np.ndarray, corners: np.ndarray) -> tuple[float, float, float] | None:
    """Light of the brightest part of a square with corners (4, 2); None if it is unusable."""
    if cv2.contourArea(corners.astype(np.float32)) < 60.0:  # blurred edges reach the middle
        return None
    middle = corners.mean(0)
    inner = middle + 0.9 * (corners - middle)  # the edge is mixed with black squares
    low = np.floor(inner.min(0)).astype(int)
    high = np.ceil(inner.max(0)).astype(int)
    if (low < 0).any() or high[0] > image.shape[1] or high[1] > image.shape[0]:
        return None
    part = image[low[1] : high[1], low[0] : high[0]]
    mask = np.zeros(part.shape[:2], np.uint8)
    cv2.fillConvexPoly(mask, np.rint(corner_to_opencv_pixels(inner - low)).astype(np.int32), 1)
    levels = part[mask > 0]
    order = np.argsort(levels.sum(1, dtype=np.int32), kind="stable")
    # The marker leaves more than this part white.
    paper = levels[order[-max(1, round(0.3 * len(levels))) :]]
    ink = levels[order[: max(1, round(0.1 * len(levels)))]]
    if paper.min() < 12 or paper.max() > 245:  # noise, or clipped
        return None
    light = LIGHT_OF_LEVEL[paper].mean(0)
    if light.mean() < 2.0 * LIGHT_OF_LEVEL[ink].mean():  # this is not a printed square
        return None
    return float(light[0]), float(light[1]), float(light[2])


def fit_gains(light: np.ndarray) -> GainFit:
    """Fit gains of cameras to linear light (N, C, 3) of the same N patches; NaN where not seen.

    Least squares of log light on a level per patch and a gain per camera, reweighted by Cauchy's
    loss, as reflections move with the camera. The patches' levels are eliminated, which leaves one
    equation per camera.

    Raises:
        ValueError: the shape is wrong, or light is zero, negative or infinite.
    """
    if light.ndim != 3 or light.shape[2] != 3:
        raise ValueError(f"light has shape {light.shape}, expected (N, C, 3)")
    if (light <= 0).any() or np.isinf(light).any():
        raise ValueError("light must be above 0 and finite, or NaN where a patch is not seen")
    seen = np.isfinite(light).all(-1)
    seen = seen & (seen.sum(1) >= 2)[:, None]
    tied = _tied(seen)
    weights = (seen & tied).astype(np.float64)
    value = np.log(np.where(seen[..., None], light, 1.0))
    gain = np.zeros((len(tied), 3))
    for _ in range(12):
        gain = _solve(value, weights * _trust(value - gain, weights), tied)
    return GainFit(np.exp(gain), tied, _spread(value, weights), _spread(value - gain, weights))


def _tied(seen: np.ndarray) -> np.ndarray:
    """Mark the largest set (C,) of cameras that shared patches (N, C) connect."""
    common = seen.T.astype(np.int64) @ seen
    _, group = connected_components(common >= LEAST_SHARED, directed=False)
    sizes = np.bincount(group, minlength=1)
    return (group == sizes.argmax()) & (sizes.max(initial=0) >= 2)


def _residuals(value: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Log light (N, C, 3) less the weighted mean of each patch."""
    total = np.maximum(weights.sum(1), 1e-12)[:, None]
    return value - ((weights[..., None] * value).sum(1) / total)[:, None]


def _trust(value: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Cauchy weights (N, C) of log light without the gains."""
    length = np.linalg.norm(_residuals(value, weights), axis=-1)
    used = length[weights > 0]
    # The least scale keeps weights finite where all cameras agree.
    scale = max(float(np.median(used)), 0.003) if used.size else 1.0
    return 1.0 / (1.0 + (length / (2.0 * scale)) ** 2)


def _solve(value: np.ndarray, weights: np.ndarray, tied: np.ndarray) -> np.ndarray:
    """Log gains (C, 3) with mean 0 over the tied cameras, 0 for the others."""
    gain = np.zeros((len(tied), 3))
    if not tied.any():
        return gain
    total = np.maximum(weights.sum(1), 1e-12)
    matrix = np.diag(weights.sum(0)) - weights.T @ (weights / total[:, None])
    right = (weights[..., None] * _residuals(value, weights)).sum(0)
    # A common gain changes nothing, so the mean is held.
    held = matrix[np.ix_(tied, tied)] + np.trace(matrix) / tied.sum()
    gain[tied] = np.linalg.solve(held, right[tied])
    gain[tied] -= gain[tied].mean(0)
    return gain


def _spread(value: np.ndarray, weights: np.ndarray) -> float:
    """Median departure of a patch's light from its mean over cameras, percent."""
    used = np.abs(_residuals(value, weights))[weights > 0]
    return float(100 * np.expm1(np.median(used))) if used.size else float("nan")
