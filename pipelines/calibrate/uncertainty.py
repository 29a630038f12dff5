"""State how far the cameras of a rig may be off at the head.

The covariance of all cameras follows from the derivatives of the corners' errors, boards' poses
eliminated. It is carried over to points at the head, after worlds are aligned by these points,
because later stages depend on nothing else. It assumes independent errors of corners and a true
lens model. So it is enlarged where corners of one image are off together, and where rigs from two
halves of the board images differ by more than it predicts.

Source: mrcal's projection uncertainty (Kogan, https://mrcal.secretsauce.net/uncertainty.html).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from express50.geometry.cameras import Camera, project, triangulate
from express50.geometry.transforms import rigid_fit
from pipelines.calibrate.adjuster import (
    AdjustedRig,
    RigPriors,
    cameras_covariance,
    derive_points,
    eliminate,
)
from pipelines.calibrate.board import BoardCorners
from pipelines.calibrate.board_adjust import (
    BoardRig,
    adjust_board_rig,
    corner_errors,
    derive,
    derive_corners,
    rig_covariance,
    rigid_steps,
)
from pipelines.calibrate.board_rig import LEAST_CORNERS, BoardSolution
from pipelines.calibrate.tracks import PointTracks

HEAD_RADIUS_M = 0.13
DRAWS = 3  # of independent errors, to compare those of whole images with


@dataclass(frozen=True)
class HeadError:
    """Expected error (root mean square) of where a camera sees points of the head: px, mm there."""

    px: float
    mm: float


def state_uncertainty(solution: BoardSolution, points: np.ndarray) -> dict[str, HeadError]:
    """Estimate each camera's error in the head's place; empty for a lone camera.

    Cameras that have this place behind them are left out, as they see nothing of it.
    `points` (P, 3) are corners on the board. Where rigs of two halves of the board images differ by
    more than the covariance predicts, the variance is multiplied by the mean of 1 and the squared
    ratio.
    """
    cameras = {n: c for n, c in solution.cameras.items() if c.cam_from_world[2, 3] > HEAD_RADIUS_M}
    if len(cameras) < 2:
        return {}
    facing = np.array([name in cameras for name in solution.corners.cameras])
    keep = facing[solution.corners.camera]
    corners, errors = solution.corners.select(keep), solution.errors[keep]
    rig, head = BoardRig(cameras, solution.boards), head_points()
    length = np.linalg.norm(errors, axis=1)
    scale = 2 * max(float(np.median(length)) / 1.1774, 1e-3)
    # The corners' noise per camera, pixels, as a fit with Cauchy's loss passes it.
    sigma, weight = np.full(len(corners.cameras), 1e-6), 1 / (1 + (length / scale) ** 2)
    for i in np.unique(corners.camera):
        mine = corners.camera == i
        pull = np.sqrt(np.mean((weight[mine] * length[mine]) ** 2) / 2)
        sigma[i] = max(pull / np.mean(weight[mine] ** 2), 1e-6)
    squared = _expected(rig, corners, points, sigma, head)
    # Each half has every other board frame, and only the cameras that both halves hold.
    side = np.searchsorted(np.unique(corners.frame), corners.frame) % 2
    seen = np.zeros((2, len(corners.cameras)))
    np.add.at(seen, (side, corners.camera), 1)
    held = (seen.min(0) >= LEAST_CORNERS)[corners.camera]
    halves = [corners.select(held & (side == k)) for k in (0, 1)]
    if len(np.unique(halves[0].camera)) > 1:
        one, other = (adjust_board_rig(rig, half, points, scale).cameras for half in halves)
        variance = [_expected(rig, half, points, sigma, head) for half in halves]
        for name, off in camera_errors(one, other, head).items():
            squared[name] *= max(1.0, (1 + off**2 / sum(half[name] for half in variance)) / 2)
    depth = {name: camera.cam_from_world[2, 3] for name, camera in cameras.items()}
    return {n: head_error_of(cameras[n], squared[n], depth[n]) for n in sorted(cameras)}


def head_error_of(camera: Camera, squared_px: float, distance_m: float) -> HeadError:
    """Return the error of a camera so far from the head, from its square in pixels."""
    px = float(np.sqrt(squared_px))
    return HeadError(px, 1e3 * px * float(distance_m) / camera.focal)


def head_points() -> np.ndarray:
    """Return points (40, 3) on a sphere about the canonical world's origin, where the head is."""
    points = np.random.default_rng(0).normal(size=(40, 3))
    return HEAD_RADIUS_M * points / np.linalg.norm(points, axis=1, keepdims=True)


def camera_errors(
    found: Mapping[str, Camera], true: Mapping[str, Camera], points: np.ndarray
) -> dict[str, float]:
    """Return by camera the rms distance, pixels, of points (N, 3) in two rigs' pictures.

    The points are the true rig's. Worlds are laid on each other by the points as either rig
    triangulates them. A camera's rotation and principal point trade places without harm there, but
    would tilt a fit to the cameras themselves.
    """
    names = sorted(found)
    seen = np.stack([project(true[name], points)[0] for name in names])
    R, t = rigid_fit(points, triangulate([found[name] for name in names], seen))
    offs = [project(found[n], points @ R.T + t)[0] - p for n, p in zip(names, seen, strict=True)]
    rms = np.sqrt(np.mean(np.sum(np.stack(offs) ** 2, axis=-1), axis=1))
    return dict(zip(names, rms.tolist(), strict=True))


def _expected(
    rig: BoardRig, corners: BoardCorners, points: np.ndarray, sigma: np.ndarray, head: np.ndarray
) -> dict[str, float]:
    """Return the expected squared error, pixels, of points (K, 3) of the head by camera.

    `sigma` is the noise of corners by the number that their camera has in `corners`. Errors grow
    as corners of one image are off together.
    """
    present, camera = np.unique(corners.camera, return_inverse=True)
    names = [corners.cameras[i] for i in present]
    frames, group = np.unique(corners.frame, return_inverse=True)
    by_camera, by_board = derive_corners(rig, corners, points)
    noise = sigma[corners.camera][:, None]
    by_camera, by_board = by_camera / noise[..., None], by_board / noise[..., None]
    errors = corner_errors(rig, corners, points) / noise
    together, alone = _together(errors, corners), 0.0
    rng = np.random.default_rng(0)
    for _ in range(DRAWS):  # what the unknowns leave of independent errors
        drawn = rng.normal(size=errors.shape)
        normal = eliminate(by_camera, by_board, drawn, camera, group, len(names))
        covariance = rig_covariance(normal)
        step = covariance @ normal.right
        drawn += np.einsum("nij,nj->ni", by_camera, step.reshape(len(names), -1)[camera])
        drawn += np.einsum("nij,nj->ni", by_board, normal.follow(step)[group])
        alone += _together(drawn, corners) / DRAWS
    unknowns = np.count_nonzero(normal.diagonal) + 6 * (len(frames) - 1)
    left = max(1 - unknowns / errors.size, 0.1)  # share that the unknowns did not absorb
    derived = zip(*[derive(rig.cameras[name], head) for name in names], strict=True)
    by_head, by_point = (np.stack(part) for part in derived)
    squared = _squared_errors(by_head, by_point, rigid_steps(head), covariance / left)
    excess = max(1.0, together / max(alone, 1e-9))
    return dict(zip(names, (excess * squared).tolist(), strict=True))


def _together(errors: np.ndarray, corners: BoardCorners) -> float:
    """Return the squared sums of errors (N, 2) over images, over the sum of their squares."""
    image = corners.camera * len(corners.frames) + corners.frame
    sums = [np.bincount(image, errors[:, i]) for i in (0, 1)]
    return float(np.sum(np.square(sums)) / np.sum(errors**2))


def _squared_errors(
    by_camera: np.ndarray, by_point: np.ndarray, motions: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """Return the expected squared errors (C,), pixels, to first order as `camera_errors` measures.

    Pixels of K points are derived by their camera's unknowns (C, K, 2, U) and by the points (C, K,
    2, 3), the points by the motions (K, 3, M) that lay worlds on each other.
    """
    count, own = len(by_camera), np.arange(len(by_camera))
    inverse = np.linalg.inv(np.einsum("ckij,ckil->kjl", by_point, by_point))
    shift = -np.einsum("kjl,ckil,ckip->kjcp", inverse, by_point, by_camera, optimize=True)
    flat = shift.reshape(motions.shape[0] * 3, -1)
    motion = np.linalg.lstsq(motions.reshape(len(flat), -1), flat, rcond=None)[0]
    moved = np.einsum("ckij,kjm,mp->ckip", by_point, motions, motion, optimize=True)
    moved.reshape(*moved.shape[:3], count, -1)[own, :, :, own] += by_camera
    return np.einsum("ckip,pq,ckiq->ck", moved, covariance, moved, optimize=True).mean(1)


def footage_uncertainty(
    fit: AdjustedRig,
    tracks: PointTracks,
    priors: RigPriors,
    scale: float,
    middle: np.ndarray,
    radius: float,
) -> dict[str, float]:
    """Estimate each camera's error, pixels, about the middle (3,) of a head, of a rig from footage.

    Worlds are aligned by similarities, because footage does not determine the metre.
    """
    points = middle + radius / HEAD_RADIUS_M * head_points()
    turned = rigid_steps(points - middle)
    motions = np.concatenate([turned, (points - middle)[..., None]], axis=2)
    derived = derive_points([fit.cameras[name] for name in tracks.names], points)
    covariance = cameras_covariance(fit, tracks, priors, scale)
    squared = _squared_errors(*derived, motions, covariance)
    return dict(zip(tracks.names, np.sqrt(squared).tolist(), strict=True))
