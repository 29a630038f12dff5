"""Set up the studio: cameras with their sensors, the calibration board, and the room.

The cameras stand on a part of a sphere around the subject, closer together at the front.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from express50.geometry.cameras import Camera
from express50.geometry.conventions import cell_centres, corner_to_cell
from express50.geometry.pixels import compress_highlights, linear_to_srgb
from express50.geometry.sampling import smoothstep
from express50.geometry.transforms import axis_angle_to_matrix, look_at, make_transform
from express50.twin.render import RowBand, bands, ray_pattern
from express50.twin.surface import (
    fractal,
    make_lattice,
    noise,
    sample_panorama,
    spherical_to_unit,
    unit,
    unit_to_spherical,
)

TARGET = np.array([0.0, 1.25, 0.0])  # where heads are: a seated person, y up, metres
SPAN_DEG = 300.0
RADIUS_M = 1.05
FRAME_M = 0.43  # what the shorter image side shows at the target; a head fills about 60 %
_RINGS_DEG = (4.0, 21.0, -13.0, 11.0, 28.0, -4.0)


def make_rig(count: int, width: int, height: int, seed: int) -> dict[str, Camera]:
    """Draw cameras cam00... by id, distorted (COLMAP's OPENCV model), in the true world.

    The rig depends on the seed alone: the same cameras record every subject. Camera 0 is leftmost
    as the subject sees it; the world's y is up and subjects look along +z.
    """
    rng = np.random.default_rng([seed, 101])
    cameras, short = {}, min(width, height)
    for index in range(count):
        camera_id = f"cam{index:02d}"
        place = 2.0 * (index + 0.5) / count - 1.0
        # The slope is under 1 in the middle, so cameras are closer at the front.
        azimuth = math.radians(0.5 * SPAN_DEG) * (0.8 * place + 0.2 * place**3)
        azimuth += math.radians(rng.uniform(-2.0, 2.0))
        elevation = math.radians(_RINGS_DEG[index % len(_RINGS_DEG)] + rng.uniform(-1.5, 1.5))
        radius = RADIUS_M * (1.0 + rng.uniform(-0.04, 0.04))
        out = np.array(
            [
                -math.sin(azimuth) * math.cos(elevation),
                math.sin(elevation),
                math.cos(azimuth) * math.cos(elevation),
            ]
        )
        aim = TARGET + rng.uniform(-0.012, 0.012, 3)
        tilt = np.array([math.tan(math.radians(rng.uniform(-1.5, 1.5))), 1.0, 0.0])
        pose = look_at(TARGET + radius * out, aim, tilt)
        focal = short * radius / FRAME_M * (1.0 + rng.uniform(-0.02, 0.02))
        aspect = 1.0 + rng.uniform(-0.0015, 0.0015)
        cx, cy = np.array([width, height]) / 2 + short * rng.uniform(-0.012, 0.012, 2)
        k1, k2 = rng.uniform(-0.22, -0.08), rng.uniform(0.05, 0.3)
        p1, p2 = rng.uniform(-0.0012, 0.0012, 2)
        lens = tuple(float(x) for x in (focal, focal * aspect, cx, cy, k1, k2, p1, p2))
        cameras[camera_id] = Camera(camera_id, width, height, "OPENCV", lens, pose)
    return cameras


_SHOT, _READ = 0.0055, 0.0016  # noise of a clean studio exposure, linear light
_CURVE_STEPS = 16384


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """One camera's colour gain (3,), and how much darker its corners are."""

    gain: np.ndarray
    vignette: float


def make_sensor(camera_index: int, seed: int) -> Sensor:
    """Draw a camera's sensor."""
    rng = np.random.default_rng([seed, 301, camera_index])
    gain = 0.85 * rng.uniform(0.94, 1.06) * (1.0 + rng.normal(0.0, 0.025, 3))
    return Sensor(gain=gain.astype(np.float32), vignette=float(rng.uniform(0.02, 0.08)))


def expose(
    sensor: Sensor, linear: np.ndarray, rng: np.random.Generator, noise: float
) -> np.ndarray:
    """Return the 8-bit sRGB picture (H, W, 3) of linear light (H, W, 3) float32."""
    height, width = linear.shape[:2]
    y = cell_centres(height).astype(np.float32) / height * 2 - 1
    x = cell_centres(width).astype(np.float32) / width * 2 - 1
    falloff = 1.0 - sensor.vignette * 0.5 * (x[None] ** 2 + y[:, None] ** 2)
    signal = linear * sensor.gain * falloff[..., None]
    if noise > 0:
        grain = rng.standard_normal(signal.shape, dtype=np.float32)
        signal = signal + noise * grain * np.sqrt(_READ**2 + _SHOT**2 * np.maximum(signal, 0.0))
    steps = np.clip(signal * (_CURVE_STEPS / 2.0), 0, _CURVE_STEPS - 1).astype(np.int32)
    return _CURVE[steps]


# 8-bit levels of linear light 0 to 2 in steps of at most half a level. Light over the knee is
# compressed, so that highlights do not clip abruptly.
_LIGHT = (np.arange(_CURVE_STEPS) + 0.5) * 2.0 / _CURVE_STEPS
_CURVE = np.rint(255.0 * linear_to_srgb(compress_highlights(_LIGHT))).astype(np.uint8)


SQUARES = (7, 5)  # columns and rows
SQUARE_M, MARKER_M = 0.042, 0.0315
DICTIONARY = "DICT_4X4_50"
BOARD_TOML = f"""squares_x = {SQUARES[0]}
squares_y = {SQUARES[1]}
square_length_m = {SQUARE_M}
marker_length_m = {MARKER_M}
dictionary = "{DICTIONARY}"
"""
_TEXELS = 24  # a square's side in the pattern; a marker takes 18: six cells of three
_MARGIN = 12  # white border, texels
_RAYS = 17  # per pixel; odd, because an even number would shift the picture


def charuco_board() -> cv2.aruco.CharucoBoard:
    """Return OpenCV's description of the board; metres, x right, y down, z into the board."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    return cv2.aruco.CharucoBoard(SQUARES, SQUARE_M, MARKER_M, dictionary)


def board_poses(count: int, seed: int) -> list[np.ndarray]:
    """Return ``world_from_board`` (4, 4) of every synchronised frame.

    The board turns through the rig's arc in golden-section order, so that for any count every
    camera sees it several times, and neighbours see it together.
    """
    rng = np.random.default_rng([seed, 401])
    middle = np.array([*SQUARES, 0.0]) * 0.5 * SQUARE_M
    poses = []
    for k in range(count):
        place = ((k + 0.5) * 0.61803399) % 1.0
        azimuth = math.radians(SPAN_DEG) * (place - 0.5)
        tilt, roll = rng.uniform(-0.45, 0.35), rng.uniform(-0.5, 0.5)
        turns = np.array([[0.0, -azimuth, 0.0], [tilt, 0.0, 0.0], [0.0, 0.0, roll]])
        about_y, about_x, about_z = axis_angle_to_matrix(turns)
        # Board axes as its viewer sees them: x right, y down, z away from the viewer.
        R = about_y @ np.diag([1.0, -1.0, -1.0]) @ about_x @ about_z
        shift = rng.uniform(-1.0, 1.0, 3) * (0.075, 0.075, 0.08)
        poses.append(make_transform(R, TARGET + R @ shift - R @ middle))
    return poses


@cache
def board_pattern() -> np.ndarray:
    """Return the printed pattern (H, W) float32, 0 to 1, white margin included."""
    size = (SQUARES[0] * _TEXELS, SQUARES[1] * _TEXELS)
    image = charuco_board().generateImage(size, None, 0, 1)
    return np.pad(image, _MARGIN, constant_values=255).astype(np.float32) / 255.0


def render_board(world_from_board: np.ndarray, camera: Camera, seed: int) -> np.ndarray:
    """Render the board in the studio as a linear picture (H, W, 3) float32.

    Every pixel averages the pattern over several rays.
    """
    image = np.empty((camera.height, camera.width, 3), np.float32)
    normal = -world_from_board[:3, 2]
    faces_camera = normal @ (camera.center - world_from_board[:3, 3]) > 0
    # Paper is lighter where it faces the front and the ceiling.
    light = float(0.62 + 0.2 * max(0.0, normal[2]) + 0.12 * normal[1])
    for band, view in studio_bands(camera, seed):
        if faces_camera:
            centre, right, down = (p[band.rows] for p in (band.centre, band.right, band.down))
            paper = np.zeros(centre.shape[:2], np.float32)
            cover = np.zeros_like(paper)
            for du, dv in zip(*ray_pattern(_RAYS), strict=True):
                directions = centre + du * right + dv * down
                hit, tone = _meet_board(world_from_board, band.origin, directions)
                cover += hit / _RAYS
                paper += hit * tone / _RAYS
            view = view * (1 - cover[..., None]) + (light * paper)[..., None]
        image[band.top : band.bottom] = view
    return image


def _meet_board(
    world_from_board: np.ndarray, origin: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Intersect rays (h, w, 3) with the board; return hits (h, w) float32 and their tones."""
    R = world_from_board[:3, :3]
    start = R.T @ (origin - world_from_board[:3, 3])
    turned = directions @ R
    reach = -start[2] / np.where(np.abs(turned[..., 2]) < 1e-9, np.inf, turned[..., 2])
    scale = _TEXELS / SQUARE_M
    x = np.floor((start[0] + reach * turned[..., 0]) * scale + _MARGIN).astype(np.int64)
    y = np.floor((start[1] + reach * turned[..., 1]) * scale + _MARGIN).astype(np.int64)
    pattern = board_pattern()
    height, width = pattern.shape
    hit = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (reach > 0) & (turned[..., 2] > 0)
    tone = pattern[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
    return hit.astype(np.float32), 0.03 + 0.77 * tone


ROOM_M = 2.6
_HIGHEST = 0.95  # largest elevation of the wall, radians; no camera sees further up or down


def studio_bands(camera: Camera, seed: int) -> Iterator[tuple[RowBand, np.ndarray]]:
    """Yield a camera's bands, each with the empty studio's linear picture (h, w, 3) float32."""
    # Texels around the room: few, because it is out of focus.
    width = int(np.clip(2 ** np.round(np.log2(2 * np.pi * camera.K[0, 0] * 0.35)), 2048, 4096))
    room = _room(seed, width)
    height = len(room)
    for band in bands(camera):
        rays = band.centre[band.rows]
        d = unit(rays.reshape(-1, 3))
        start = np.asarray(band.origin - TARGET, d.dtype)
        b = d @ start
        reach = -b + np.sqrt(np.maximum(b * b - start @ start + ROOM_M**2, 0.0))
        az, el = unit_to_spherical(start + reach[:, None] * d)
        x = corner_to_cell((az / (2 * np.pi) + 0.5) * width)
        y = np.clip(corner_to_cell((el / (2 * _HIGHEST) + 0.5) * height), 0, height - 1.01)
        yield band, sample_panorama(room, x, y).astype(np.float32).reshape(rays.shape)


@cache
def _room(seed: int, width: int) -> np.ndarray:
    """Paint the room's wall (H, W, 3) float32, by azimuth and elevation from its middle."""
    rng = np.random.default_rng([seed, 201])
    height = 2 * round(width * _HIGHEST / (2 * np.pi))
    az = (cell_centres(width) / width * 2 * np.pi - np.pi).astype(np.float32)
    el = ((cell_centres(height) / height * 2 - 1) * _HIGHEST).astype(np.float32)
    base = np.array([0.17, 0.185, 0.20]) * rng.uniform(0.85, 1.2) * rng.uniform(0.93, 1.07, 3)
    # Felt panels with dark seams; each is a little different.
    columns, rows = az / (2 * np.pi) * 22, (el + 0.5 * np.pi) / np.pi * 9
    seam_x = smoothstep(np.abs(columns - np.round(columns)) / 22, 0.0004, 0.0016)
    seam_y = smoothstep(np.abs(rows - np.round(rows)) / 18, 0.0004, 0.0016)
    x, y = np.meshgrid(np.floor(columns) * 3.7, np.floor(rows) * 5.3)
    own = noise(np.stack([x, y, 0 * x], -1).reshape(-1, 3), make_lattice(rng)).reshape(x.shape)
    panels = (0.55 + 0.45 * seam_x * seam_y[:, None]) * (1 + 0.22 * own)
    shade = (1 + 0.35 * np.clip(el, -0.8, 0.8))[:, None] * panels
    # The felt's blotches are smooth, so half the size is enough.
    points = spherical_to_unit(*np.meshgrid(az[::2], el[::2])).reshape(-1, 3) * ROOM_M
    felt = 1 + 0.16 * fractal(points, make_lattice(rng), 0.55, 4, 0.55)
    shade *= cv2.resize(felt.reshape(height // 2, width // 2), (width, height))
    wall = shade[..., None] * base.astype(np.float32)
    for _ in range(14):
        _pole(rng, wall, az, el)
    for _ in range(4):  # sagging cables
        top, waves = rng.uniform(-0.6, 0.7), rng.integers(2, 6)
        line = top + 0.12 * np.abs(np.sin(0.5 * waves * az + rng.uniform(0, 6)))
        near = np.flatnonzero((el > top - 0.01) & (el < top + 0.13))
        inside = smoothstep(np.abs(el[near, None] - line), 0.006, 0.003)[..., None]
        wall[near] += inside * (np.array([0.03, 0.03, 0.033]) - wall[near])
    for _ in range(10):
        _lamp(rng, wall, az, el)
    # The wall is far behind the plane of focus.
    return cv2.GaussianBlur(wall, None, 0.0016 * width / (2 * np.pi) + 0.7)


def _around(az: np.ndarray, centre: float | np.ndarray) -> np.ndarray:
    """Return angles from a centre, wrapped to [-pi, pi)."""
    return (az - centre + np.pi) % (2 * np.pi) - np.pi


def _pole(rng: np.random.Generator, wall: np.ndarray, az: np.ndarray, el: np.ndarray) -> None:
    """Paint a steel stand with rounded shading into ``wall``."""
    centre, half = rng.uniform(-np.pi, np.pi), rng.uniform(0.006, 0.016)
    lean, metal, tint = rng.uniform(-0.08, 0.08), rng.uniform(0.05, 0.4), rng.uniform(0.9, 1.1, 3)
    near = np.flatnonzero(np.abs(_around(az, centre)) < 0.14 + 2 * half)
    across = _around(az[near], centre + lean * el[:, None]) / half
    inside = smoothstep(np.abs(across), 1.08, 0.92)[..., None]
    round_shade = metal * (0.25 + 0.75 * np.sqrt(np.clip(1 - across**2, 0, 1)))
    wall[:, near] += inside * (round_shade[..., None] * tint - wall[:, near])


def _lamp(rng: np.random.Generator, wall: np.ndarray, az: np.ndarray, el: np.ndarray) -> None:
    """Paint a bright or dark box, such as a light or a camera, into ``wall``."""
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
