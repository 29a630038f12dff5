"""Intrinsics of one camera from its own views of the board, and the poses each view allows.

These start the joint solution, so they must survive bad frames rather than be exact.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from express50.geometry.cameras import Camera
from express50.geometry.transforms import make_transform

# A view whose corners span less than this share of the image's diagonal says little of the lens.
SMALLEST_SPAN = 0.03
# The mirrored pose of a flat target is ruled out when its error is this factor above the other's.
CLEARLY_WORSE = 2.5


@dataclass(frozen=True)
class View:
    """Corners of one board image: object points (N, 3) metres and pixels (N, 2).

    `ideal` (N, 2) are the pixels in normalised coordinates without distortion, once the camera
    is known.
    """

    frame: int
    points: np.ndarray
    pixels: np.ndarray
    ideal: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))


def seen_from_front(view: View) -> bool:
    """Tell whether the corners run round the board in the sense its printed side shows.

    A mirrored image (or wrong ids) turns the sense round, and no camera can then explain it.
    """
    flat = np.column_stack([view.points[:, :2], np.ones(len(view.points))])
    affine, _, rank, _ = np.linalg.lstsq(flat, view.pixels, rcond=None)
    return bool(rank == 3 and np.linalg.det(affine[:2]) > 0)


def usable(view: View, size: tuple[int, int], min_corners: int) -> bool:
    """Tell whether a view has enough corners, spread over two directions, to hold a pose."""
    if len(view.pixels) < min_corners:
        return False
    centred = view.points[:, :2] - view.points[:, :2].mean(0)
    spread = np.linalg.svd(centred, compute_uv=False)
    span = np.linalg.norm(np.ptp(view.pixels, axis=0)) / np.hypot(*size)
    return bool(spread[1] > 0.1 * spread[0] and span > SMALLEST_SPAN)


def fit_intrinsics(
    views: list[View], size: tuple[int, int], model: str, min_frames: int
) -> tuple[np.ndarray, np.ndarray, list[int]] | None:
    """Fit focal lengths, principal point and distortion to views of a flat board.

    Views that fit three times worse than the median view are put aside and the rest fitted
    again, at most three times. Returns K (3, 3), distortion (5,) in OpenCV's order and the
    indices of the views used, or None when fewer than `min_frames` views hold together.
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
    views: list[View], size: tuple[int, int], model: str
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
        # A long lens and few views let the principal point run away: then hold it at the middle.
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
    """The camera in another model; distortion that the model does not have is left out."""
    return replace(camera, model=model, params=camera_params(camera.K, camera.dist, model))


def with_ideal(camera: Camera, view: View) -> View:
    """The view with its normalised, undistorted coordinates in this camera."""
    ideal = cv2.undistortPoints(view.pixels[:, None], camera.K, camera.dist[None])[:, 0]
    return replace(view, ideal=ideal)


def board_poses(view: View) -> list[np.ndarray]:
    """Poses cam_from_board (4, 4) that explain a view (with `ideal` set), best first.

    A small flat target has two of them that may reproject almost alike (IPPE, Collins and Bartoli
    2014); which one is true only the other cameras can tell. The second is left out where it
    fits clearly worse.
    """
    # Object points are centred because IPPE asks for it; the shift is put back into the pose.
    middle = view.points.mean(0)
    centred, eye = view.points - middle, np.eye(3)
    count, rotations, translations, _ = cv2.solvePnPGeneric(
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
    limit = CLEARLY_WORSE * max(found[0][0], 1e-6) if found else 0.0
    return [pose for error, pose in found if error <= limit]
