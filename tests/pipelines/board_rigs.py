"""Rigs of known cameras before known board poses, as corner observations or as images."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from express50.geometry.cameras import Camera, project, rays
from express50.geometry.transforms import axis_angle_to_matrix, look_at, make_transform
from pipelines.calibrate.board import Board, BoardCorners, board_points, gather, opencv_board

BOARD = Board(11, 8, 0.05, 0.037, "DICT_5X5_250")
POINTS = board_points(BOARD)


def make_rig(
    count: int,
    focal: float = 900.0,
    size: tuple[int, int] = (640, 480),
    distance: float = 1.1,
    span_deg: float = 150.0,
    far: float = 0.0,
) -> dict[str, Camera]:
    """OPENCV cameras on an arc round a point `far` metres from the origin."""
    rig = {}
    middle = np.array([far, 0.0, 0.0])
    for i in range(count):
        angle = np.radians(span_deg * ((i + 0.5) / count - 0.5))
        eye = distance * np.array([np.sin(angle), 0.2 * np.sin(3 * angle), np.cos(angle)])
        pose = look_at(middle + eye, middle + [0.02 * np.sin(i), 0.01 * i, 0])
        f = focal * (1 + 0.03 * np.sin(2 * i))
        cx, cy = size[0] * (0.5 + 0.01 * np.sin(i)), size[1] * (0.5 - 0.01 * np.cos(i))
        # Radial terms bend the image's corner by a few pixels at any focal length.
        reach = np.hypot(*size) / 2 / f
        params = (f, f * 1.001, cx, cy, -0.02 / reach**2, 0.005 / reach**4, 0.0, 0.0)
        rig[f"cam{i:02d}"] = Camera(f"cam{i:02d}", *size, "OPENCV", params, pose)
    return rig


def board_motion(
    count: int, seed: int, span_deg: float = 150.0, shift: float = 0.15, far: float = 0.0
) -> list[np.ndarray]:
    """World_from_board (4, 4) of boards that face the arc in turn, tilted and shifted."""
    rng = np.random.default_rng(seed)
    poses = []
    for i in range(count):
        angle = np.radians(span_deg * (((i * 7) % count + 0.5) / count - 0.5))
        z = -np.array([np.sin(angle), 0.0, np.cos(angle)])  # into the board
        y = np.array([0.0, -1.0, 0.0])
        facing = np.stack([np.cross(y, z), y, z], axis=1)
        R = facing @ axis_angle_to_matrix(rng.normal(size=3) * 0.4)
        at = rng.uniform(-shift, shift, 3) + [far, 0, 0]
        poses.append(make_transform(R, at - R @ POINTS.mean(0)))
    return poses


def observe(
    rig: dict[str, Camera],
    boards: list[np.ndarray],
    noise_px: float,
    seed: int = 0,
    both_sides: bool = False,
) -> BoardCorners:
    """Corners in view from the print's side, or from both, with normal noise."""
    rng = np.random.default_rng(seed)
    rows = []
    for number, board in enumerate(boards):
        world = POINTS @ board[:3, :3].T + board[:3, 3]
        for name, camera in rig.items():
            towards = camera.center - world.mean(0)
            slope = towards @ board[:3, 2] / np.linalg.norm(towards)
            if (-abs(slope) if both_sides else slope) > -0.3:
                continue
            pixels, _ = project(camera, world)
            seen = ((pixels > 0) & (pixels < (camera.width, camera.height))).all(axis=1)
            ids = np.flatnonzero(seen)
            noisy = pixels[ids] + rng.normal(size=(len(ids), 2)) * noise_px
            rows.append((name, f"{number:03d}", ids, noisy))
    return gather(rows, rig)


def sizes_of(rig: dict[str, Camera]) -> dict[str, tuple[int, int]]:
    """(width, height) of every camera."""
    return {name: (camera.width, camera.height) for name, camera in rig.items()}


def rig_errors(estimated: dict[str, Camera], true: dict[str, Camera]) -> tuple[float, float, float]:
    """Largest rotation error [deg], position error [m], focal error [%] after a rigid fit."""
    names = sorted(estimated)
    total = sum(
        true[n].cam_from_world[:3, :3].T @ estimated[n].cam_from_world[:3, :3] for n in names
    )
    U, _, Vt = np.linalg.svd(total)
    R = U @ Vt
    shift = np.mean([true[n].center - R @ estimated[n].center for n in names], axis=0)
    rotation = position = focal = 0.0
    for name in names:
        off = true[name].cam_from_world[:3, :3] @ R @ estimated[name].cam_from_world[:3, :3].T
        sine = np.linalg.norm(off - off.T) / np.sqrt(8)
        rotation = max(rotation, float(np.degrees(np.arcsin(min(sine, 1.0)))))
        moved = R @ estimated[name].center + shift
        position = max(position, float(np.linalg.norm(moved - true[name].center)))
        ratio = estimated[name].K[0, 0] / true[name].K[0, 0]
        focal = max(focal, 100 * abs(ratio - 1))
    return rotation, position, focal


@lru_cache(maxsize=1)
def _seen_rays(
    width: int, height: int, model: str, params: tuple[float, ...], samples: int
) -> np.ndarray:
    """Directions (H, W, 3) in the camera's axes of `samples` x `samples` rays a pixel.

    They are kept, because inverting the lens takes most of a picture's time.
    """
    finer = tuple(p * samples if i < 4 else p for i, p in enumerate(params))
    return rays(Camera("", width * samples, height * samples, model, finer, np.eye(4)))[1]


def render_board(camera: Camera, board: np.ndarray, samples: int = 3) -> np.ndarray:
    """Image (H, W, 3) uint8 of the board on grey, `samples` x `samples` rays a pixel.

    The print is looked up by ray and plane, so that lens distortion and the pixel grid are exact
    and owe nothing to OpenCV's own projection.
    """
    texels = 40
    across, down = BOARD.squares_x * texels, BOARD.squares_y * texels
    pattern = opencv_board(BOARD).generateImage((across, down), None, 0, 1).astype(np.float64)
    seen = _seen_rays(camera.width, camera.height, camera.model, camera.params, samples)
    local = seen @ (camera.cam_from_world[:3, :3] @ board[:3, :3])
    start = board[:3, :3].T @ (camera.center - board[:3, 3])
    hit = start + local * (-start[2] / local[..., 2])[..., None]
    column = np.floor(hit[..., 0] / BOARD.square_length_m * texels).astype(int)
    row = np.floor(hit[..., 1] / BOARD.square_length_m * texels).astype(int)
    on = (column >= 0) & (row >= 0) & (column < across) & (row < down)
    on &= start[2] < 0  # seen from the print's side
    image = np.full(column.shape, 128.0)
    image[on] = 40 + 0.7 * pattern[row[on], column[on]]
    shape = (camera.height, samples, camera.width, samples)
    gray = np.rint(image.reshape(shape).mean(axis=(1, 3))).astype(np.uint8)
    return cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB)
