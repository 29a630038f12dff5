"""Measure cameras' colour gains against each other, per channel, on the board's white paper.

Matt paper reflects nearly the same light in all directions. So a camera's gain is the light that it
records of a square, over what the others record at the same instant. Faces do not serve: their
gloss differs between cameras by more than the gains do (docs/LOG.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse.csgraph import connected_components

from express50.geometry.conventions import corner_to_opencv_pixels
from express50.geometry.pixels import LIGHT_OF_LEVEL
from pipelines.calibrate.board import Board, opencv_board

LEAST_SHARED = 12  # squares that two cameras must see together to be compared


@dataclass(frozen=True)
class ColourGains:
    """The responses of cameras to the same light."""

    gain: dict[str, np.ndarray]  # linear light (3,) over the cameras' geometric mean
    before: float | None  # median departure of a square's light from its mean over cameras, percent
    after: float | None  # the same with the gains divided out; None if no two compare
    squares: int


class WhiteCollector:
    """Collects the light of the board's white squares while its images are read."""

    def __init__(self, board: Board) -> None:
        self.squares = white_squares(board)
        self.light: dict[tuple[str, str, int], np.ndarray] = {}
        """Linear light (3,) by camera, frame and square."""

    def look(
        self, camera: str, frame: str, image: np.ndarray, ids: np.ndarray, pixels: np.ndarray
    ) -> None:
        """Add one image (H, W, 3) uint8 with its corners: ids (N,), pixels (N, 2)."""
        light = white_light(image, ids, pixels, self.squares)
        self.light |= {(camera, frame, square): value for square, value in light.items()}

    def gains(self, cameras: Sequence[str]) -> ColourGains:
        """Measure the gains of some cameras."""
        number = {name: i for i, name in enumerate(cameras)}
        seen = {key: value for key, value in self.light.items() if key[0] in number}
        patches = {key: i for i, key in enumerate(sorted({key[1:] for key in seen}))}
        light = np.full((len(patches), len(cameras), 3), np.nan)
        for (camera, frame, square), value in seen.items():
            light[patches[frame, square], number[camera]] = value
        gain, before, after = fit_gains(light)
        found = {n: row for n, row in zip(cameras, gain, strict=True) if np.isfinite(row).all()}
        return ColourGains(found, before, after, len(self.light))


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
) -> dict[int, np.ndarray]:
    """Measure the linear light (3,) of the squares' paper in an image (H, W, 3) uint8, by square.

    `ids` (N,) are the inner corners seen at `pixels` (N, 2), `squares` are from `white_squares`.
    Those that are too small, cut off, clipped or too dark are left out.
    """
    place = dict(zip(ids.tolist(), pixels, strict=True))
    found = {}
    for number, ids_around in squares.items():
        if not set(ids_around.tolist()) <= set(place):
            continue
        corners = np.array([place[corner] for corner in ids_around.tolist()])
        if cv2.contourArea(corners.astype(np.float32)) < 60.0:  # blurred edges reach the middle
            continue
        middle = corners.mean(0)
        inner = middle + 0.9 * (corners - middle)  # the edge is mixed with black squares
        low, high = np.floor(inner.min(0)).astype(int), np.ceil(inner.max(0)).astype(int)
        if (low < 0).any() or high[0] > image.shape[1] or high[1] > image.shape[0]:
            continue
        part = image[low[1] : high[1], low[0] : high[0]]
        mask = np.zeros(part.shape[:2], np.uint8)
        cv2.fillConvexPoly(mask, np.rint(corner_to_opencv_pixels(inner - low)).astype(np.int32), 1)
        levels = part[mask > 0]
        order = np.argsort(levels.sum(1, dtype=np.int32), kind="stable")
        # The marker leaves more than this part white.
        paper = levels[order[-max(1, round(0.3 * len(levels))) :]]
        ink = levels[order[: max(1, round(0.1 * len(levels)))]]
        light = LIGHT_OF_LEVEL[paper].mean(0)
        usable = paper.min() >= 12 and paper.max() <= 245  # above the noise, and not clipped
        if usable and light.mean() >= 2.0 * LIGHT_OF_LEVEL[ink].mean():  # a printed square
            found[number] = light
    return found


def fit_gains(light: np.ndarray) -> tuple[np.ndarray, float | None, float | None]:
    """Fit gains of cameras to linear light (N, C, 3) of the same N patches; NaN where not seen.

    Least squares of log light on a level per patch, eliminated, and a gain per camera, with
    Cauchy's loss as reflections move with the camera.

    Returns gains (C, 3) with a geometric mean of 1, NaN where nothing ties a camera to the others,
    and `before` and `after` of `ColourGains`.
    """
    seen = np.isfinite(light).all(-1)
    seen = seen & (seen.sum(1) >= 2)[:, None]
    # The largest set of cameras that shared patches connect.
    shared = seen.T.astype(np.int64) @ seen
    group = connected_components(shared >= LEAST_SHARED, directed=False)[1]
    sizes = np.bincount(group, minlength=1)
    tied = (group == sizes.argmax()) & (sizes.max(initial=0) >= 2)
    gain = np.full((len(tied), 3), np.nan)
    if not tied.any():
        return gain, None, None
    weights = seen[:, tied].astype(np.float64)
    value = np.log(np.where(seen[..., None], light, 1.0))[:, tied]
    logs = np.zeros((tied.sum(), 3))
    for _ in range(12):
        length = np.linalg.norm(_departures(value - logs, weights), axis=-1)
        # The least scale keeps weights finite where all cameras agree.
        scale = max(float(np.median(length[weights > 0])), 0.003)
        trusted = weights / (1.0 + (length / (2.0 * scale)) ** 2)
        total = np.maximum(trusted.sum(1), 1e-12)
        matrix = np.diag(trusted.sum(0)) - trusted.T @ (trusted / total[:, None])
        right = (trusted[..., None] * _departures(value, trusted)).sum(0)
        # A common gain changes nothing, so the mean is held.
        logs = np.linalg.solve(matrix + np.trace(matrix) / len(matrix), right)
        logs -= logs.mean(0)
    gain[tied] = np.exp(logs)
    before, after = (
        float(100 * np.expm1(np.median(np.abs(_departures(rest, weights))[weights > 0])))
        for rest in (value, value - logs)
    )
    return gain, before, after


def _departures(value: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return log light (N, C, 3) less the weighted mean of each patch."""
    total = np.maximum(weights.sum(1), 1e-12)[:, None]
    return value - ((weights[..., None] * value).sum(1) / total)[:, None]
