"""Which cameras have to move for footage to fit: robust least squares over points and poses.

Intrinsics stay. Points are eliminated (Schur complement), so that freeing any one camera, with all
points following it, is one small solve.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from express50.geometry.cameras import Camera
from express50.geometry.transforms import axis_angle_to_matrix, make_transform
from pipelines.calibrate.tracks import Tracks

# How far a camera may be taken to have moved before the footage has a say.
PRIOR_RAD, PRIOR_M = np.radians(1.0), 0.01
ROUNDS = 8
# Residuals flatten at this many expected errors: a camera that is off by a few pixels bends the
# points it shares, and must not be weighed away with the mismatches.
CAUCHY = 1.5


@dataclass(frozen=True)
class Normal:
    """Normal equations of one linearisation, points eliminated.

    Attributes:
        S: (6C, 6C) reduced matrix, rotation then translation of each camera in its own axes.
        b: (6C,) right side.
        cameras: (N, 2, 6) derivatives of the pixels by the pose of the row's camera.
        points: (N, 2, 3) derivatives by the point.
        inverse: (P, 3, 3) inverses of the points' own blocks.
        weights: (N,) robust weights, 1 / pixel^2.
        errors: (N, 2) pixels, predicted less seen.
    """

    S: np.ndarray
    b: np.ndarray
    cameras: np.ndarray
    points: np.ndarray
    inverse: np.ndarray
    weights: np.ndarray
    errors: np.ndarray


@dataclass(frozen=True)
class Fit:
    """Poses (C, 4, 4) cam_from_world and points (P, 3) that fit, and the last linearisation."""

    poses: np.ndarray
    points: np.ndarray
    normal: Normal


def triangulate_tracks(cameras: Mapping[str, Camera], tracks: Tracks) -> np.ndarray:
    """Points (P, 3) nearest to their rays in least squares, robustly weighted in two rounds."""
    pose = np.stack([cameras[n].cam_from_world for n in tracks.names])[tracks.camera]
    K = np.stack([cameras[n].K for n in tracks.names])[tracks.camera]
    xy = (tracks.pixels - K[:, :2, 2]) / K[:, [0, 1], [0, 1]]
    d = np.einsum("nji,nj->ni", pose[:, :3, :3], np.column_stack([xy, np.ones(len(xy))]))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    centre = -np.einsum("nji,nj->ni", pose[:, :3, :3], pose[:, :3, 3])
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    weight = (K[:, 0, 0] / tracks.sigma) ** 2
    count = int(tracks.point.max(initial=-1)) + 1
    for _ in range(3):
        A = _sum_by(weight[:, None, None] * across, tracks.point, count)
        right = np.einsum("nij,nj->ni", across, centre) * weight[:, None]
        right = _sum_by(right, tracks.point, count)
        trace = np.trace(A, axis1=1, axis2=2)[:, None, None]
        points = np.linalg.solve(A + 1e-9 * trace * np.eye(3), right[..., None])[..., 0]
        gap = np.einsum("nij,nj->ni", across, points[tracks.point] - centre)
        reach = np.maximum(np.linalg.norm(points[tracks.point] - centre, axis=1), 1e-6)
        angle = np.linalg.norm(gap, axis=1) / reach * K[:, 0, 0] / tracks.sigma
        weight = (K[:, 0, 0] / tracks.sigma / reach) ** 2 / (1 + (angle / 3) ** 2)
    return points


def fit_poses(
    cameras: Mapping[str, Camera],
    tracks: Tracks,
    points: np.ndarray,
    free: tuple[str, ...],
) -> Fit:
    """Move points, and the poses of the `free` cameras, until they fit the tracks.

    Weights are Cauchy's, wide at first.
    """
    poses = np.stack([cameras[n].cam_from_world for n in tracks.names])
    moved = np.zeros((len(poses), 6))
    K = np.stack([cameras[n].K for n in tracks.names])
    columns = _columns([tracks.names.index(n) for n in free])
    for number in range(ROUNDS + 1):
        normal = linearise(poses, K, points, tracks, CAUCHY * max(1.0, 4.0 - number))
        if number == ROUNDS:
            break
        step = np.zeros(6 * len(poses))
        if len(columns):
            prior = _prior(len(poses))[columns]
            S = normal.S[np.ix_(columns, columns)] + np.diag(prior)
            right = normal.b[columns] - prior * moved.reshape(-1)[columns]
            step[columns] = np.linalg.solve(S, right)
        points = points + point_steps(normal, tracks, step.reshape(-1, 6))
        moved += step.reshape(-1, 6)
        poses = np.stack([move_pose(T, d) for T, d in zip(poses, step.reshape(-1, 6), strict=True)])
    return Fit(poses, points, normal)


def linearise(
    poses: np.ndarray, K: np.ndarray, points: np.ndarray, tracks: Tracks, scale: float
) -> Normal:
    """Normal equations at poses (C, 4, 4), intrinsics (C, 3, 3) and points (P, 3).

    `scale` is where Cauchy's weights have fallen to a half, in expected errors.
    """
    pose, focal = poses[tracks.camera], K[tracks.camera][:, [0, 1], [0, 1]]
    local = np.einsum("nij,nj->ni", pose[:, :3, :3], points[tracks.point]) + pose[:, :3, 3]
    ahead = local[:, 2] > 1e-3
    z = np.where(ahead, local[:, 2], 1.0)
    errors = local[:, :2] / z[:, None] * focal + K[tracks.camera][:, :2, 2] - tracks.pixels
    J = np.zeros((len(z), 2, 3))
    J[:, [0, 1], [0, 1]] = focal / z[:, None]
    J[:, :, 2] = -focal * local[:, :2] / z[:, None] ** 2
    of_points = np.einsum("nij,njk->nik", J, pose[:, :3, :3])
    of_cameras = np.concatenate([np.einsum("nij,njk->nik", J, -_cross(local)), J], axis=2)
    size = np.linalg.norm(errors, axis=1) / tracks.sigma
    weights = np.where(ahead, 1 / tracks.sigma**2 / (1 + (size / scale) ** 2), 0.0)
    return _reduce(of_cameras, of_points, weights, errors, tracks, len(poses))


def _reduce(
    of_cameras: np.ndarray,
    of_points: np.ndarray,
    weights: np.ndarray,
    errors: np.ndarray,
    tracks: Tracks,
    count: int,
) -> Normal:
    """Eliminate the points; Triggs et al., Bundle Adjustment, 2000, section 6.1."""
    total = int(tracks.point.max(initial=-1)) + 1
    heavy = of_points * weights[:, None, None]
    V = _sum_by(np.einsum("nki,nkj->nij", heavy, of_points), tracks.point, total)
    V += 1e-9 * (1 + np.trace(V, axis1=1, axis2=2))[:, None, None] * np.eye(3)
    inverse = np.linalg.inv(V)
    W = np.einsum("nki,nkj->nij", of_cameras, heavy)  # (N, 6, 3)
    Y = np.einsum("nij,njk->nik", W, inverse[tracks.point])
    right = _sum_by(np.einsum("nki,nk->ni", heavy, errors), tracks.point, total)
    own = np.einsum("nki,nkj->nij", of_cameras * weights[:, None, None], of_cameras)
    S = np.zeros((count, count, 6, 6))
    np.add.at(S, (tracks.camera, tracks.camera), own)
    first, second = _pairs(tracks.point)
    product = np.einsum("nij,nkj->nik", Y[first], W[second])
    np.subtract.at(S, (tracks.camera[first], tracks.camera[second]), product)
    b = np.einsum("nij,nj->ni", Y, right[tracks.point])
    b -= np.einsum("nki,nk->ni", of_cameras, weights[:, None] * errors)
    return Normal(
        S.transpose(0, 2, 1, 3).reshape(6 * count, 6 * count),
        _sum_by(b, tracks.camera, count).reshape(-1),
        of_cameras,
        of_points,
        inverse,
        weights,
        errors,
    )


def point_steps(normal: Normal, tracks: Tracks, steps: np.ndarray) -> np.ndarray:
    """How points (P, 3) follow when the cameras move by steps (C, 6)."""
    moved = normal.errors + np.einsum("nij,nj->ni", normal.cameras, steps[tracks.camera])
    pull = np.einsum("nki,nk->ni", normal.points * normal.weights[:, None, None], moved)
    pull = _sum_by(pull, tracks.point, len(normal.inverse))
    return -np.einsum("nij,nj->ni", normal.inverse, pull)


def lone_steps(fit: Fit, free: tuple[int, ...]) -> np.ndarray:
    """The step (C, 6) each camera would take if it alone were freed besides the `free` ones."""
    S, b = fit.normal.S, fit.normal.b
    count = len(fit.poses)
    steps = np.zeros((count, 6))
    for index in range(count):
        if index not in free:
            columns = _columns([*free, index])
            A = S[np.ix_(columns, columns)] + np.diag(_prior(count)[columns])
            steps[index] = np.linalg.solve(A, b[columns])[-6:]
    return steps


def cost(fit: Fit, tracks: Tracks) -> float:
    """Robust cost of a fit: half the squared residuals over sigma, flattened as Cauchy's."""
    size = np.linalg.norm(fit.normal.errors, axis=1) / tracks.sigma
    return 0.5 * CAUCHY**2 * float(np.log1p((size / CAUCHY) ** 2).sum())


def move_pose(cam_from_world: np.ndarray, step: np.ndarray) -> np.ndarray:
    """The pose (4, 4) after a small rotation and translation (6,) in the camera's axes."""
    return make_transform(axis_angle_to_matrix(step[:3]), step[3:]) @ cam_from_world


def with_poses(
    cameras: Mapping[str, Camera], tracks: Tracks, poses: np.ndarray
) -> dict[str, Camera]:
    """The cameras with other poses (C, 4, 4)."""
    return {
        name: replace(cameras[name], cam_from_world=pose)
        for name, pose in zip(tracks.names, poses, strict=True)
    }


def _prior(count: int) -> np.ndarray:
    return np.tile(np.repeat([PRIOR_RAD**-2, PRIOR_M**-2], 3), count)


def _columns(indices: list[int]) -> np.ndarray:
    return (6 * np.array(indices, int)[:, None] + np.arange(6)).reshape(-1)


def _cross(v: np.ndarray) -> np.ndarray:
    """Matrices (N, 3, 3) of the cross product with v (N, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, [0, 1, 2], [1, 2, 0]] = -v[:, [2, 0, 1]]
    out[:, [1, 2, 0], [0, 1, 2]] = v[:, [2, 0, 1]]
    return out


def _sum_by(rows: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """Sums (count, ...) of rows (N, ...) by their group (N,)."""
    out = np.zeros((count, *rows.shape[1:]))
    np.add.at(out, group, rows)
    return out


def _pairs(group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All ordered pairs of rows (M,), (M,) of one group, a row with itself included."""
    order = np.argsort(group, kind="stable")
    sizes = np.bincount(group)
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    first = np.repeat(order, sizes[group[order]])
    within = np.concatenate([np.tile(np.arange(n), n) for n in sizes] or [np.zeros(0, int)])
    second = order[starts[group[first]] + within]
    return first, second
