"""Intrinsics of one camera from its own views of the board, and the poses each view allows.

They start the joint solution, so surviving bad frames matters more than being exact.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from express50.geometry.cameras import Camera
from express50.geometry.transforms import make_transform
from pipelines.calibrate.board import BoardCorners

MIN_CORNERS = 8
"""Corners that a board image needs to count."""


@dataclass(frozen=True)
class BoardView:
    """Corners of one board image: object points (N, 3) metres and pixels (N, 2).

    `ideal` (N, 2) are the pixels in normalised coordinates without distortion, once the camera
    is known.
    """

    frame: int
    points: np.ndarray
    pixels: np.ndarray
    ideal: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))


def seen_from_front(view: BoardView) -> bool:
    """Check that the corners run round the board in the sense that its printed side shows.

    Mirrored images and wrong ids reverse the sense, and no camera can then explain them.
    """
    flat = np.column_stack([view.points[:, :2], np.ones(len(view.points))])
    affine, _, rank, _ = np.linalg.lstsq(flat, view.pixels, rcond=None)
    return bool(rank == 3 and np.linalg.det(affine[:2]) > 0)


def board_views(
    corners: BoardCorners, camera: str, points: np.ndarray, size: tuple[int, int]
) -> list[BoardView]:
    """List a camera's board images that hold a pose, in order of frame.

    They have enough corners, spread over two directions and over more than 3 % of the diagonal of
    an image of `size` (width, height). `points` (P, 3) are the corners on the board.
    """
    mine = corners.camera == corners.cameras.index(camera)
    found = []
    for frame in np.unique(corners.frame[mine]):
        rows = mine & (corners.frame == frame)
        view = BoardView(int(frame), points[corners.corner[rows]], corners.pixels[rows])
        if len(view.pixels) < MIN_CORNERS:
            continue
        flat = view.points[:, :2] - view.points[:, :2].mean(0)
        spread = np.linalg.svd(flat, compute_uv=False)
        span = np.linalg.norm(np.ptp(view.pixels, axis=0)) / np.hypot(*size)
        if spread[1] > 0.1 * spread[0] and span > 0.03:
            found.append(view)
    return found


def fit_intrinsics(
    views: list[BoardView], size: tuple[int, int], model: str, min_frames: int
) -> tuple[np.ndarray, np.ndarray, list[int]] | None:
    """Fit focal lengths, principal point and distortion to views of a flat board.

    Views that fit three times worse than the median view are set aside and the rest fitted
    again, at most three times. Returns K (3, 3), distortion (5,) in OpenCV's order and the
    indices of the views used, or None if fewer than `min_frames` views agree.
    """
    use = list(range(len(views)))
    for _ in range(4):
        if len(use) < min_frames:
            return None
        fitted = _calibrate([views[i] for i in use], size, model)
        if fitted is None:
            return None
        K, dist, errors = fitted
        good = errors <= max(3.0 * float(np.median(errors)), 0.3)
        if good.all():
            break
        use = [i for i, ok in zip(use, good, strict=True) if ok]
    return K, dist, use


def _calibrate(
    views: list[BoardView], size: tuple[int, int], model: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Run OpenCV's calibration (Zhang 2000); K, distortion (5,), rms (V,) pixels."""
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    flags = cv2.CALIB_FIX_K3
    if model != "OPENCV":
        flags |= cv2.CALIB_ZERO_TANGENT_DIST
    if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "PINHOLE"):
        flags |= cv2.CALIB_FIX_K2
    if model in ("SIMPLE_PINHOLE", "PINHOLE"):
        flags |= cv2.CALIB_FIX_K1
    for extra in (0, cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_K2):
        # With a long lens and few views the principal point diverges: then hold it at the middle.
        try:
            _, K, dist, *_, errors = cv2.calibrateCameraExtended(
                points, pixels, size, None, None, flags=flags | extra
            )
        except cv2.error:
            continue
        inside = 0 < K[0, 2] < size[0] and 0 < K[1, 2] < size[1]
        if inside and np.isfinite(K).all() and np.isfinite(dist).all() and K[0, 0] > 0:
            return K, dist.ravel()[:5], errors.ravel()
    return None


def camera_params(K: np.ndarray, dist: np.ndarray, model: str) -> tuple[float, ...]:
    """Write K (3, 3) and OpenCV's distortion (5,) in COLMAP's parameter order of `model`."""
    fx, fy, cx, cy = (float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    k1, k2, p1, p2 = (float(v) for v in dist[:4])
    return {
        "SIMPLE_PINHOLE": ((fx + fy) / 2, cx, cy),
        "PINHOLE": (fx, fy, cx, cy),
        "SIMPLE_RADIAL": ((fx + fy) / 2, cx, cy, k1),
        "RADIAL": ((fx + fy) / 2, cx, cy, k1, k2),
        "OPENCV": (fx, fy, cx, cy, k1, k2, p1, p2),
    }[model]


def as_model(camera: Camera, model: str) -> Camera:
    """Convert a camera to another model; distortion that the model lacks is left out."""
    return replace(camera, model=model, params=camera_params(camera.K, camera.dist, model))


def with_ideal(camera: Camera, view: BoardView) -> BoardView:
    """Add the normalised, undistorted coordinates of this camera to a view."""
    ideal = cv2.undistortPoints(view.pixels[:, None], camera.K, camera.dist[None])[:, 0]
    return replace(view, ideal=ideal)


def board_poses(view: BoardView) -> list[np.ndarray]:
    """List the poses cam_from_board (4, 4) that explain a view (with `ideal` set), best first.

    A small flat target has two of them that may reproject almost alike (IPPE, Collins and Bartoli
    2014), and only the other cameras can decide. The second is left out where it fits 2.5 times
    worse.
    """
    # IPPE needs centred object points; the shift is put back into the pose.
    middle = view.points.mean(0)
    centred, eye = view.points - middle, np.eye(3)
    _, rotations, translations, _ = cv2.solvePnPGeneric(
        centred, view.ideal, eye, None, flags=cv2.SOLVEPNP_IPPE
    )
    found = []
    for rotation, translation in zip(rotations, translations, strict=True):
        refined = cv2.solvePnPRefineLM(centred, view.ideal, eye, None, rotation, translation)
        pose = make_transform(cv2.Rodrigues(refined[0])[0], refined[1].ravel())
        pose[:3, 3] -= pose[:3, :3] @ middle
        placed = view.points @ pose[:3, :3].T + pose[:3, 3]
        if np.isfinite(placed).all() and placed[:, 2].min() > 0:
            error = placed[:, :2] / placed[:, 2:] - view.ideal
            found.append((float(np.sqrt(np.mean(error**2))), pose))
    found.sort(key=lambda item: item[0])
    limit = 2.5 * max(found[0][0], 1e-6) if found else 0.0
    return [pose for error, pose in found if error <= limit]
