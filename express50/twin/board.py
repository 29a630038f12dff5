"""A ChArUco board held before the cameras: synchronised poses that face different directions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from express50.geometry.cameras import Camera, project
from express50.geometry.transforms import axis_angle_to_matrix, make_transform
from express50.twin.background import background, room_width
from express50.twin.noise import random_stream
from express50.twin.render import bands, ray_pattern
from express50.twin.rig import SPAN_DEG, TARGET

_TEXELS = 24  # a square's side in the pattern; a marker takes 18: six cells of three
_MARGIN = 0.5  # white border, squares
_RAYS = 16


@dataclass(frozen=True, kw_only=True)
class BoardSpec:
    """The board as board.toml describes it; marker_length_m must be 3/4 of square_length_m."""

    squares_x: int = 7
    squares_y: int = 5
    square_length_m: float = 0.042
    marker_length_m: float = 0.0315
    dictionary: str = "DICT_4X4_50"

    def toml(self) -> str:
        """Content of board.toml."""
        return (
            f"squares_x = {self.squares_x}\nsquares_y = {self.squares_y}\n"
            f"square_length_m = {self.square_length_m}\nmarker_length_m = {self.marker_length_m}\n"
            f'dictionary = "{self.dictionary}"\n'
        )


def corner_points(spec: BoardSpec) -> np.ndarray:
    """Inner corners (N, 3) in board space: metres, x right, y down, z into the board."""
    x, y = np.meshgrid(np.arange(1, spec.squares_x), np.arange(1, spec.squares_y))
    flat = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    return flat * spec.square_length_m


def board_poses(spec: BoardSpec, count: int, seed: int) -> list[np.ndarray]:
    """``world_from_board`` (4, 4) of every synchronised frame.

    The board turns through the rig's arc twice in golden-section order, so that every camera sees
    it several times and neighbours see it together, whatever the count.
    """
    rng = random_stream(seed, 401)
    middle = np.array([spec.squares_x, spec.squares_y, 0.0]) * 0.5 * spec.square_length_m
    poses = []
    for k in range(count):
        place = ((k + 0.5) * 0.61803399) % 1.0
        azimuth = math.radians(SPAN_DEG) * (place - 0.5)
        tilt, roll = rng.uniform(-0.45, 0.35), rng.uniform(-0.5, 0.5)
        # Board axes as its viewer sees them: x right, y down, z away from the viewer.
        facing = _about_y(-azimuth) @ np.diag([1.0, -1.0, -1.0])
        R = facing @ axis_angle_to_matrix(np.array([tilt, 0.0, 0.0]))
        R = R @ axis_angle_to_matrix(np.array([0.0, 0.0, roll]))
        shift = rng.uniform(-1.0, 1.0, 3) * (0.075, 0.075, 0.08)
        poses.append(make_transform(R, TARGET + R @ shift - R @ middle))
    return poses


def _about_y(angle: float) -> np.ndarray:
    return axis_angle_to_matrix(np.array([0.0, angle, 0.0]))


def board_pattern(spec: BoardSpec) -> np.ndarray:
    """The printed pattern (H, W) float32, 0 to 1, white margin included."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
    size = (spec.squares_x, spec.squares_y)
    board = cv2.aruco.CharucoBoard(size, spec.square_length_m, spec.marker_length_m, dictionary)
    image = board.generateImage((size[0] * _TEXELS, size[1] * _TEXELS), None, 0, 1)
    margin = round(_MARGIN * _TEXELS)
    return cv2.copyMakeBorder(
        image, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255
    ).astype(np.float32) / 255.0  # fmt: skip


def render_board(
    spec: BoardSpec, world_from_board: np.ndarray, camera: Camera, seed: int
) -> np.ndarray:
    """Linear picture (H, W, 3) float32 of the board in the studio, by meeting rays with its plane.

    Every pixel averages the pattern over several rays; the pattern itself is exact at any scale.
    """
    pattern = board_pattern(spec)
    image = np.empty((camera.height, camera.width, 3), np.float32)
    u, v = ray_pattern(_RAYS)
    low, high = _rows_of(spec, world_from_board, camera)
    for band in bands(camera):
        rows = slice(band.pad[0], band.pad[0] + band.bottom - band.top)
        centre, right, down = (part[rows] for part in (band.centre, band.right, band.down))
        view = background(seed, band.origin, centre.reshape(-1, 3), room_width(camera))
        view = view.reshape(centre.shape)
        if band.bottom > low and band.top < high:
            paper = np.zeros(centre.shape[:2], np.float32)
            cover = np.zeros_like(paper)
            for du, dv in zip(u, v, strict=True):
                hit, tone = _meet(
                    spec, pattern, world_from_board, band.origin, centre + du * right + dv * down
                )
                cover += hit / _RAYS
                paper += hit * tone / _RAYS
            light = _brightness(world_from_board)
            view = view * (1 - cover[..., None]) + (light * paper)[..., None]
        image[band.top : band.bottom] = view
    return image


def _rows_of(spec: BoardSpec, world_from_board: np.ndarray, camera: Camera) -> tuple[float, float]:
    """First and last row that the board can reach; none when the camera is behind it."""
    if world_from_board[:3, 2] @ (camera.center - world_from_board[:3, 3]) >= 0:
        return math.inf, -math.inf
    width, height = spec.squares_x, spec.squares_y
    edge = [(x, y, 0.0) for x in np.linspace(-_MARGIN, width + _MARGIN, 9)
            for y in np.linspace(-_MARGIN, height + _MARGIN, 9)]  # fmt: skip
    points = np.array(edge) * spec.square_length_m
    pixels, depth = project(camera, points @ world_from_board[:3, :3].T + world_from_board[:3, 3])
    if not (depth > 0).all():
        return 0.0, math.inf
    return pixels[:, 1].min() - 2, pixels[:, 1].max() + 2


def _meet(
    spec: BoardSpec,
    pattern: np.ndarray,
    world_from_board: np.ndarray,
    origin: np.ndarray,
    directions: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Whether rays (h, w, 3) meet the board, and the pattern's tone there."""
    R = world_from_board[:3, :3]
    start = R.T @ (origin - world_from_board[:3, 3])
    turned = directions @ R
    reach = -start[2] / np.where(np.abs(turned[..., 2]) < 1e-9, np.inf, turned[..., 2])
    scale = _TEXELS / spec.square_length_m
    margin = _MARGIN * _TEXELS
    x = np.floor((start[0] + reach * turned[..., 0]) * scale + margin).astype(np.int64)
    y = np.floor((start[1] + reach * turned[..., 1]) * scale + margin).astype(np.int64)
    height, width = pattern.shape
    hit = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (reach > 0) & (turned[..., 2] > 0)
    tone = pattern[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
    return hit.astype(np.float32), 0.03 + 0.77 * tone


def _brightness(world_from_board: np.ndarray) -> float:
    """Light on the paper: more where it faces the front and the ceiling."""
    normal = -world_from_board[:3, 2]
    return float(0.62 + 0.2 * max(0.0, normal[2]) + 0.12 * normal[1])
