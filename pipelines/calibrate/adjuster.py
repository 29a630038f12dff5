"""Bundle adjustment of whole rigs over footage: poses, lenses and points at once.

COLMAP's adjuster, which the board uses, takes all observations for equally good and knows nothing
of what is likely. Footage is seen through landmarks off by many pixels beside features off by a
fraction of one, and says little of a lens: here every observation has its own expected error, and
every unknown a spread about where it starts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse

from express50.geometry.cameras import Camera, distort
from pipelines.calibrate.adjust import move_pose
from pipelines.calibrate.tracks import Tracks

UNKNOWNS = 10
"""A camera's: rotation (3), translation (3), log focal length, centre (2), first radial term."""
ITERATIONS = 60
"""Enough for rigs of tens of cameras; longer runs move poses by less than they are off."""
_TWO_FOCALS = ("PINHOLE", "OPENCV", "FULL_OPENCV")
_NO_BEND = ("SIMPLE_PINHOLE", "PINHOLE")


@dataclass(frozen=True, kw_only=True)
class Freedom:
    """How far unknowns may be from where they start, as standard deviations.

    0 holds them, infinity frees them.
    """

    turn_rad: float = np.inf
    """Rotation of a camera."""
    move_m: float = np.inf
    """Translation of a camera, in the units of the points."""
    focal: float = 0.0
    """Focal length, as a share of it."""
    focal_spread: float = np.inf
    """Focal length against the mean of all cameras, as a share of it."""
    centre: float = 0.0
    """Principal point, as a share of the image's diagonal."""
    bend: float = 0.0
    """First radial term, as what it does at the image's corner: a share of the half diagonal."""


@dataclass(frozen=True)
class Adjusted:
    """Cameras and points (P, 3) that fit, and the errors (N, 2), pixels, of the observations."""

    cameras: dict[str, Camera]
    points: np.ndarray
    errors: np.ndarray


@dataclass(frozen=True)
class _Linear:
    """Derivatives (N, 2, 10) by the cameras and (N, 2, 3) by the points, errors (N, 2)."""

    of_cameras: np.ndarray
    of_points: np.ndarray
    errors: np.ndarray
    ahead: np.ndarray


def adjust_rig(
    cameras: Mapping[str, Camera],
    tracks: Tracks,
    points: np.ndarray,
    freedom: Freedom,
    scale: float,
    iterations: int,
) -> Adjusted:
    """Fit cameras and points to tracks by Levenberg and Marquardt's method.

    Args:
        cameras: where to start; those of `tracks.names`.
        tracks: pixels undistorted by these very cameras.
        points: (P, 3) where the points are thought to be.
        freedom: what may move, and how far.
        scale: where Cauchy's weight of an observation has fallen to a half, in expected errors.
        iterations: at most.

    Source: Triggs et al., Bundle Adjustment, a Modern Synthesis, 2000.
    """
    names = tracks.names
    rig = [cameras[name] for name in names]
    seen = recorded_pixels(rig, tracks)
    prior, columns = _prior(rig, freedom)
    start = np.array([np.log(_focal(camera)) for camera in rig])
    moved = np.zeros((len(rig), UNKNOWNS))
    at = _linearise(rig, tracks, seen, points)
    lowest, damping = _cost(at, tracks, scale, prior, moved, start), 1e-3
    for _ in range(iterations):
        step, shifts = _solve(at, tracks, scale, prior, columns, moved, start, damping)
        tried = [_moved(camera, row) for camera, row in zip(rig, step, strict=True)]
        then = _linearise(tried, tracks, seen, points + shifts)
        cost = _cost(then, tracks, scale, prior, moved + step, start)
        if not cost < lowest:
            damping *= 8
            if damping > 1e8:
                break
            continue
        gain = (lowest - cost) / max(lowest, 1e-12)
        rig, points, moved, at, lowest = tried, points + shifts, moved + step, then, cost
        damping = max(damping / 5, 1e-9)
        if gain < 1e-7:
            break
    return Adjusted(dict(zip(names, rig, strict=True)), points, at.errors)


def recorded_pixels(rig: list[Camera], tracks: Tracks) -> np.ndarray:
    """Where the cameras recorded the tracks' undistorted pixels (N, 2)."""
    out = tracks.pixels.copy()
    for index, camera in enumerate(rig):
        mine = tracks.camera == index
        K = camera.K
        xy = (tracks.pixels[mine] - K[:2, 2]) / K[[0, 1], [0, 1]]
        out[mine] = distort(camera, xy) * K[[0, 1], [0, 1]] + K[:2, 2]
    return out


def _focal(camera: Camera) -> float:
    return float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))


def _moved(camera: Camera, step: np.ndarray) -> Camera:
    """The camera after a step (10,) of its unknowns."""
    p = list(camera.params)
    focals = 2 if camera.model in _TWO_FOCALS else 1
    for i in range(focals):
        p[i] *= float(np.exp(np.clip(step[6], -0.5, 0.5)))
    p[focals] += float(step[7])
    p[focals + 1] += float(step[8])
    if camera.model not in _NO_BEND:
        p[focals + 2] += float(step[9])
    return replace(
        camera, params=tuple(p), cam_from_world=move_pose(camera.cam_from_world, step[:6])
    )


def _prior(rig: list[Camera], freedom: Freedom) -> tuple[np.ndarray, np.ndarray]:
    """Information matrix (10C, 10C) of the unknowns' spreads, and the columns that are free.

    Its part for the focal lengths' common mean acts on the logarithms themselves.
    """
    spreads = np.zeros((len(rig), UNKNOWNS))
    spreads[:, :3], spreads[:, 3:6] = freedom.turn_rad, freedom.move_m
    for row, camera in zip(spreads, rig, strict=True):
        diagonal = float(np.hypot(camera.width, camera.height))
        row[6], row[7:9] = freedom.focal, freedom.centre * diagonal
        reach = diagonal / 2 / _focal(camera)
        row[9] = 0.0 if camera.model in _NO_BEND else freedom.bend / reach**2
    flat = spreads.reshape(-1)
    columns = np.flatnonzero(flat > 0)
    information = np.zeros(len(flat))
    information[columns] = flat[columns] ** -2.0
    prior = np.diag(information)
    if freedom.focal > 0 and freedom.focal_spread > 0 and np.isfinite(freedom.focal_spread):
        focals = np.arange(len(rig)) * UNKNOWNS + 6
        centring = np.eye(len(rig)) - 1 / len(rig)
        prior[np.ix_(focals, focals)] += centring / freedom.focal_spread**2
    return prior, columns


def _offsets(prior: np.ndarray, moved: np.ndarray, start: np.ndarray) -> np.ndarray:
    """What the prior pulls on (10C,): steps so far, and the focal lengths' own differences."""
    pulled = moved.copy()
    if (prior[6::UNKNOWNS, 6::UNKNOWNS] - np.diag(np.diag(prior)[6::UNKNOWNS])).any():
        pulled[:, 6] += start - start.mean()
    return pulled.reshape(-1)


def _linearise(rig: list[Camera], tracks: Tracks, seen: np.ndarray, points: np.ndarray) -> _Linear:
    count = len(seen)
    of_cameras, of_points = np.zeros((count, 2, UNKNOWNS)), np.zeros((count, 2, 3))
    errors, ahead = np.zeros((count, 2)), np.zeros(count, bool)
    for index, camera in enumerate(rig):
        mine = np.flatnonzero(tracks.camera == index)
        R, t = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
        local = points[tracks.point[mine]] @ R.T + t
        ahead[mine] = local[:, 2] > 1e-3
        z = np.where(ahead[mine], local[:, 2], 1.0)
        xy = np.clip(local[:, :2] / z[:, None], -5, 5)
        focal = camera.K[[0, 1], [0, 1]]
        bent, by_xy, by_k1 = _lens(camera, xy)
        errors[mine] = bent * focal + camera.K[:2, 2] - seen[mine]
        by_xy *= focal[:, None]
        by_local = (
            np.concatenate([by_xy, -np.einsum("nij,nj->ni", by_xy, xy)[:, :, None]], axis=2)
            / z[:, None, None]
        )
        of_points[mine] = by_local @ R
        of_cameras[mine, :, :3] = -by_local @ _cross(local)
        of_cameras[mine, :, 3:6] = by_local
        of_cameras[mine, :, 6] = bent * focal
        of_cameras[mine[:, None], [0, 1], [7, 8]] = 1.0
        of_cameras[mine, :, 9] = by_k1 * focal
    return _Linear(of_cameras, of_points, errors, ahead)


def _lens(camera: Camera, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distorted coordinates (N, 2) and their derivatives by xy (N, 2, 2) and by k1 (N, 2)."""
    bent, step = distort(camera, xy), 1e-6
    by_xy = np.stack([(distort(camera, xy + d) - bent) / step for d in step * np.eye(2)], axis=2)
    if camera.model in _NO_BEND:
        return bent, by_xy, np.zeros_like(bent)
    nudge = np.zeros(UNKNOWNS)
    nudge[9] = step
    return bent, by_xy, (distort(_moved(camera, nudge), xy) - bent) / step


def _cross(v: np.ndarray) -> np.ndarray:
    """Matrices (N, 3, 3) of the cross product with v (N, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, [0, 1, 2], [1, 2, 0]] = -v[:, [2, 0, 1]]
    out[:, [1, 2, 0], [0, 1, 2]] = v[:, [2, 0, 1]]
    return out


def _sizes(at: _Linear, tracks: Tracks) -> np.ndarray:
    """Errors (N,) in expected ones; a point behind its camera is far off."""
    return np.where(at.ahead, np.linalg.norm(at.errors, axis=1) / tracks.sigma, 1e4)


def _cost(
    at: _Linear,
    tracks: Tracks,
    scale: float,
    prior: np.ndarray,
    moved: np.ndarray,
    start: np.ndarray,
) -> float:
    pulled = _offsets(prior, moved, start)
    robust = scale**2 * np.log1p((_sizes(at, tracks) / scale) ** 2).sum()
    return 0.5 * float(robust + pulled @ prior @ pulled)


def _solve(
    at: _Linear,
    tracks: Tracks,
    scale: float,
    prior: np.ndarray,
    columns: np.ndarray,
    moved: np.ndarray,
    start: np.ndarray,
    damping: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Damped steps (C, 10) of the cameras and (P, 3) of the points, points eliminated."""
    count, total = len(moved), int(tracks.point.max(initial=-1)) + 1
    weights = 1 / tracks.sigma**2 / (1 + (_sizes(at, tracks) / scale) ** 2)
    root = np.where(at.ahead, np.sqrt(weights), 0.0)[:, None]
    Jc = _rows(at.of_cameras * root[..., None], tracks.camera, count)
    Jp = _rows(at.of_points * root[..., None], tracks.point, total)
    errors = (at.errors * root).reshape(-1)
    U = (Jc.T @ Jc).toarray() + prior
    right = -(Jc.T @ errors) - prior @ _offsets(prior, moved, start)
    heavy = at.of_points * root[..., None]
    V = np.zeros((total, 3, 3))
    np.add.at(V, tracks.point, np.einsum("nki,nkj->nij", heavy, heavy))
    V += damping * V * np.eye(3) + 1e-9 * (1 + np.trace(V, axis1=1, axis2=2))[
        :, None, None
    ] * np.eye(3)
    inverse = sparse.bsr_matrix(
        (np.linalg.inv(V), np.arange(total), np.arange(total + 1)), shape=(3 * total, 3 * total)
    ).tocsr()
    W = (Jc.T @ Jp).tocsr()
    Y = W @ inverse
    pull = Jp.T @ errors
    S = U - (Y @ W.T).toarray() + damping * np.diag(np.diag(U))
    step = np.zeros(count * UNKNOWNS)
    block = S[np.ix_(columns, columns)]
    block += 1e-12 * np.trace(block) * np.eye(len(columns))
    step[columns] = np.linalg.solve(block, (right + Y @ pull)[columns])
    shifts = inverse @ (-pull - W.T @ step)
    return step.reshape(count, UNKNOWNS), shifts.reshape(total, 3)


def _rows(blocks: np.ndarray, group: np.ndarray, count: int) -> sparse.csr_matrix:
    """Sparse (2N, count * width) matrix of blocks (N, 2, width), each in its group's columns."""
    n, _, width = blocks.shape
    matrix = sparse.bsr_matrix((blocks, group, np.arange(n + 1)), shape=(2 * n, count * width))
    return matrix.tocsr()
