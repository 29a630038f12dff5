"""The room behind the subject and the calibration board."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from express50.geometry.cameras import Camera, project
from express50.geometry.conventions import cell_centres, corner_to_cell
from express50.geometry.smoothstep import smoothstep
from express50.geometry.transforms import axis_angle_to_matrix, make_transform
from express50.twin.noise import fractal, make_lattice, noise, random_stream
from express50.twin.render import bands, ray_pattern
from express50.twin.rig import SPAN_DEG, TARGET
from express50.twin.surface import spherical_to_unit, unit, unit_to_spherical

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
        """Return content of board.toml."""
        return (
            f"squares_x = {self.squares_x}\nsquares_y = {self.squares_y}\n"
            f"square_length_m = {self.square_length_m}\nmarker_length_m = {self.marker_length_m}\n"
            f'dictionary = "{self.dictionary}"\n'
        )


def corner_points(spec: BoardSpec) -> np.ndarray:
    """Return inner corners (N, 3) in board space: metres, x right, y down, z into the board."""
    x, y = np.meshgrid(np.arange(1, spec.squares_x), np.arange(1, spec.squares_y))
    flat = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    return flat * spec.square_length_m


def board_poses(spec: BoardSpec, count: int, seed: int) -> list[np.ndarray]:
    """Return ``world_from_board`` (4, 4) of every synchronised frame.

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
    """Return the printed pattern (H, W) float32, 0 to 1, white margin included."""
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
    """Return the first and last row that the board can reach; none when the camera is behind it."""
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
    """Intersect rays (h, w, 3) with the board: hit mask, and the pattern's tone there."""
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


RADIUS_M = 2.6
_HIGHEST = 0.95  # elevation up to which the wall is painted, radians; cameras see less


def room_width(camera: Camera) -> int:
    """Return texels around the room that suit a camera; out of focus; 2048 or 4096."""
    wanted = 2 * np.pi * camera.K[0, 0] * 0.35
    return int(np.clip(2 ** np.round(np.log2(wanted)), 2048, 4096))


def background(
    seed: int, origin: np.ndarray, directions: np.ndarray, width: int = 2048
) -> np.ndarray:
    """Return linear colours (N, 3) of rays that miss the subject.

    Args:
        seed: the studio's seed.
        origin: (3,) the camera's centre, inside the room.
        directions: (N, 3), any length.
        width: texels around the room.
    """
    d = unit(directions)
    start = np.asarray(origin - TARGET, d.dtype)
    b = d @ start
    reach = -b + np.sqrt(np.maximum(b * b - start @ start + RADIUS_M**2, 0.0))
    az, el = unit_to_spherical(start + reach[:, None] * d)
    room = _room(seed, width)
    height = room.shape[0]
    x = corner_to_cell((az / (2 * np.pi) + 0.5) * width)
    y = np.clip(corner_to_cell((el / (2 * _HIGHEST) + 0.5) * height), 0, height - 1.01)
    left, top = np.floor(x), np.floor(y)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    x0, y0 = left.astype(np.int32), top.astype(np.int32)
    xa, xb = x0 % width, (x0 + 1) % width
    low = room[y0, xa] * (1 - fx) + room[y0, xb] * fx
    high = room[y0 + 1, xa] * (1 - fx) + room[y0 + 1, xb] * fx
    return (low * (1 - fy) + high * fy).astype(np.float32)


@cache
def _room(seed: int, width: int) -> np.ndarray:
    """Return the room's wall (H, W, 3) float32, by azimuth and elevation from its middle."""
    rng = random_stream(seed, 201)
    height = 2 * round(width * _HIGHEST / (2 * np.pi))
    az = (cell_centres(width) / width * 2 * np.pi - np.pi).astype(np.float32)
    el = ((cell_centres(height) / height * 2 - 1) * _HIGHEST).astype(np.float32)
    base = np.array([0.17, 0.185, 0.20]) * rng.uniform(0.85, 1.2) * rng.uniform(0.93, 1.07, 3)
    shade = (1 + 0.35 * np.clip(el, -0.8, 0.8))[:, None] * _panels(az, el, make_lattice(rng))
    shade *= _felt(rng, az, el)
    wall = shade[..., None] * base.astype(np.float32)
    for _ in range(14):
        _pole(rng, wall, az, el)
    for _ in range(4):
        _cable(rng, wall, az, el)
    for _ in range(10):
        _lamp(rng, wall, az, el)
    # The wall is far behind the plane of focus.
    return cv2.GaussianBlur(wall, None, 0.0016 * width / (2 * np.pi) + 0.7)


def _felt(rng: np.random.Generator, az: np.ndarray, el: np.ndarray) -> np.ndarray:
    """Return blotches (H, W) of the wall; made at half size, they are smooth."""
    points = spherical_to_unit(*np.meshgrid(az[::2], el[::2])).reshape(-1, 3) * RADIUS_M
    grain = 1 + 0.16 * fractal(points, make_lattice(rng), 0.55, 4, 0.55)
    return cv2.resize(grain.reshape(len(el) // 2, len(az) // 2), (len(az), len(el)))


def _panels(az: np.ndarray, el: np.ndarray, lattice: np.ndarray) -> np.ndarray:
    """Return brightness (H, W) of felt panels with dark seams; each panel is a little different."""
    columns, rows = az / (2 * np.pi) * 22, (el + 0.5 * np.pi) / np.pi * 9
    seam_x = smoothstep(np.abs(columns - np.round(columns)) / 22, 0.0004, 0.0016)
    seam_y = smoothstep(np.abs(rows - np.round(rows)) / 18, 0.0004, 0.0016)
    x, y = np.meshgrid(np.floor(columns) * 3.7, np.floor(rows) * 5.3)
    own = noise(np.stack([x, y, 0 * x], -1).reshape(-1, 3), lattice).reshape(x.shape)
    return (0.55 + 0.45 * seam_x * seam_y[:, None]) * (1 + 0.22 * own)


def _around(az: np.ndarray, centre: float | np.ndarray) -> np.ndarray:
    """Return angle from a centre, wrapped to [-pi, pi)."""
    return (az - centre + np.pi) % (2 * np.pi) - np.pi


def _pole(rng: np.random.Generator, wall: np.ndarray, az: np.ndarray, el: np.ndarray) -> None:
    """Paint a steel stand with rounded shading; edits ``wall``."""
    centre, half = rng.uniform(-np.pi, np.pi), rng.uniform(0.006, 0.016)
    lean, metal, tint = rng.uniform(-0.08, 0.08), rng.uniform(0.05, 0.4), rng.uniform(0.9, 1.1, 3)
    near = np.flatnonzero(np.abs(_around(az, centre)) < 0.14 + 2 * half)
    across = _around(az[near], centre + lean * el[:, None]) / half
    inside = smoothstep(np.abs(across), 1.08, 0.92)[..., None]
    round_shade = metal * (0.25 + 0.75 * np.sqrt(np.clip(1 - across**2, 0, 1)))
    wall[:, near] += inside * (round_shade[..., None] * tint - wall[:, near])


def _cable(rng: np.random.Generator, wall: np.ndarray, az: np.ndarray, el: np.ndarray) -> None:
    """Paint a sagging cable; edits ``wall``."""
    base, waves = rng.uniform(-0.6, 0.7), rng.integers(2, 6)
    line = base + 0.12 * np.abs(np.sin(0.5 * waves * az + rng.uniform(0, 6)))
    rows = np.flatnonzero((el > base - 0.01) & (el < base + 0.13))
    inside = smoothstep(np.abs(el[rows, None] - line), 0.006, 0.003)[..., None]
    wall[rows] += inside * (np.array([0.03, 0.03, 0.033]) - wall[rows])


def _lamp(rng: np.random.Generator, wall: np.ndarray, az: np.ndarray, el: np.ndarray) -> None:
    """Paint a bright or dark box: a light, a camera housing; edits ``wall``."""
    centre, level = rng.uniform(-np.pi, np.pi), rng.uniform(-0.5, 0.6)
    w, h = rng.uniform(0.03, 0.09, 2)
    bright = rng.uniform(0.45, 0.75) if rng.uniform() < 0.4 else rng.uniform(0.03, 0.12)
    colour = bright * rng.uniform(0.92, 1.08, 3)
    columns = np.flatnonzero(np.abs(_around(az, centre)) < 1.1 * w)
    rows = np.flatnonzero(np.abs(el - level) < 1.1 * h)
    u, v = np.abs(_around(az[columns], centre)) / w, np.abs(el[rows] - level) / h
    inside = smoothstep(np.maximum(u, v[:, None]), 1.03, 0.97)[..., None]
    patch = np.ix_(rows, columns)
    wall[patch] += inside * (colour - wall[patch])
