"""Adjust a rig over footage: poses, lenses and points at once, with priors.

COLMAP's adjuster, which the board uses, weights all observations alike and has no priors on
lenses. Footage has landmarks that are off by many pixels, features that are off by a fraction of
one, and says little about a lens. So every observation has its own sigma here, and every unknown a
prior. Points are eliminated as by Triggs et al., Bundle Adjustment, a Modern Synthesis, 2000,
section 6.1, which SciPy's sparse least squares cannot do.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from express50.geometry.cameras import MODELS, Camera, distort, distortion_slopes, normalised
from express50.geometry.transforms import axis_angle_to_matrix, make_transform
from pipelines.calibrate.tracks import PointTracks

UNKNOWNS = 10
"""Per camera: rotation (3), translation (3), log focal length, centre (2), first radial term."""
ITERATIONS = 60  # longer runs move poses by less than they are off
BEHIND = 1e4  # residual of a point behind its camera, in sigmas


@dataclass(frozen=True, kw_only=True)
class RigPriors:
    """Standard deviations of the unknowns about their expected values: 0 holds, inf frees them."""

    turn_rad: float = np.inf
    move_m: float = np.inf
    focal: float = 0.0  # share of the focal length
    focal_spread: float = np.inf  # the same, against the mean of pictures of the same size
    centre: float = 0.0  # share of the image's diagonal
    bend: float = 0.0  # the first radial term's effect at the corner, over half the diagonal


@dataclass(frozen=True)
class AdjustedRig:
    """Cameras and points (P, 3) that fit, the errors (N, 2) in pixels, and their robust cost."""

    cameras: dict[str, Camera]
    points: np.ndarray
    errors: np.ndarray
    cost: float


@dataclass(frozen=True)
class _Linear:
    """Errors (N, 2), derivatives by camera (N, 2, 10) and point (N, 2, 3), sizes (N,) in sigmas."""

    errors: np.ndarray
    by_camera: np.ndarray
    by_point: np.ndarray
    sizes: np.ndarray

    def cost(self, scale: float) -> float:
        """Return half the squared sizes, flattened by Cauchy's loss."""
        return 0.5 * scale**2 * float(np.log1p((self.sizes / scale) ** 2).sum())


def adjust_rig(
    cameras: Mapping[str, Camera],
    tracks: PointTracks,
    points: np.ndarray,
    priors: RigPriors,
    scales: Sequence[float],
    free: Collection[str] | None = None,
    iterations: int = ITERATIONS,
    expected: Mapping[str, Camera] | None = None,
) -> AdjustedRig:
    """Fit cameras and points (P, 3) to tracks by the method of Levenberg and Marquardt.

    There is one fit of at most `iterations` per scale, wide ones first: the residual, in sigmas, at
    which Cauchy's weight has fallen to a half. Only `free` cameras change, None frees all. Priors
    are about the poses at the start and the lenses of `expected`, None takes those at the start.
    """
    rig = [cameras[name] for name in tracks.names]
    information, columns = _information(rig, priors, free)
    ties = _ties(rig, priors)
    moved = np.zeros((len(rig), UNKNOWNS))
    if expected is not None:
        moved[:, 6:] = [_lens(camera) - _lens(expected[camera.id]) for camera in rig]
    logs = np.array([_lens(camera)[0] for camera in rig]) - moved[:, 6]

    def prior(moved: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the priors' cost and its gradient (10C,)."""
        gradient, tied = information * moved, ties @ (logs + moved[:, 6])
        cost = 0.5 * float((gradient * moved).sum() + (logs + moved[:, 6]) @ tied)
        gradient[:, 6] += tied
        return cost, gradient.reshape(-1)

    at = _linearise(rig, tracks, points)
    for scale in scales:
        lowest, damping = at.cost(scale) + prior(moved)[0], 1e-3
        for _ in range(iterations):
            normal = _eliminate_points(at, tracks, scale, len(rig), damping)
            H = normal.cameras + np.diag(information.reshape(-1))
            H[6::UNKNOWNS, 6::UNKNOWNS] += ties
            H += damping * np.diag(normal.diagonal + information.reshape(-1))
            block = H[np.ix_(columns, columns)]
            block += 1e-12 * np.trace(block) * np.eye(len(columns))
            step = np.zeros(moved.size)
            step[columns] = np.linalg.solve(block, (normal.right - prior(moved)[1])[columns])
            shifts = normal.follow(step)
            step = step.reshape(moved.shape)
            tried = [_moved(camera, step[i]) for i, camera in enumerate(rig)]
            then = _linearise(tried, tracks, points + shifts)
            cost = then.cost(scale) + prior(moved + step)[0]
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
    found = dict(zip(tracks.names, rig, strict=True))
    return AdjustedRig(found, points, at.errors, at.cost(scales[-1]))


def cameras_covariance(
    fit: AdjustedRig, tracks: PointTracks, priors: RigPriors, scale: float
) -> np.ndarray:
    """Return the covariance (10 C, 10 C) of a fit's unknowns, all of its cameras being free.

    Where the rig stands, and how large it is, is held: a similarity changes no picture. It is as
    much larger as errors, weighted by Cauchy's loss, exceed their sigmas.
    """
    rig = [fit.cameras[name] for name in tracks.names]
    at = _linearise(rig, tracks, fit.points)
    normal = _eliminate_points(at, tracks, scale, len(rig), 0.0)
    information, columns = _information(rig, priors, None)
    H = normal.cameras + np.diag(information.reshape(-1))
    H[6::UNKNOWNS, 6::UNKNOWNS] += _ties(rig, priors)
    same = np.zeros((len(rig), UNKNOWNS, 7))
    for row, camera in zip(same, rig, strict=True):
        R, t = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
        row[:3, :3], row[3:6, :3] = -R, np.cross(R.T, t).T
        row[3:6, 3:6], row[3:6, 6] = -R, t
    # A camera that has all its points behind it is not held by anything: its variance is huge.
    unheld = columns[np.diag(H)[columns] == 0]
    H[unheld, unheld] = 1e-9 * np.diag(H).max()
    unit = 1 / np.sqrt(np.diag(H)[columns])
    held = np.linalg.qr(same.reshape(H.shape[0], 7)[columns] / unit[:, None])[0]
    inverse = np.linalg.inv(H[np.ix_(columns, columns)] * unit * unit[:, None] + held @ held.T)
    covariance = np.zeros_like(H)
    covariance[np.ix_(columns, columns)] = inverse * unit * unit[:, None]
    weight = 1 / (1 + (at.sizes / scale) ** 2)
    spare = max(2 * weight.sum() - 3 * len(fit.points) - len(columns), 0.1 * weight.sum())
    return covariance * max(1.0, float((weight * at.sizes**2).sum() / spare))


def derive_points(cameras: Sequence[Camera], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derive pixels of points (K, 3) by the camera (C, K, 2, 10) and the points (C, K, 2, 3)."""
    count, size = len(cameras), len(points)
    names = tuple(camera.id for camera in cameras)
    rows = np.repeat(np.arange(count), size), np.tile(np.arange(size), count)
    tracks = PointTracks(names, *rows, np.zeros((count * size, 2)), np.ones(count * size))
    at = _linearise(list(cameras), tracks, points)
    return at.by_camera.reshape(count, size, 2, -1), at.by_point.reshape(count, size, 2, 3)


def single_camera_gains(
    fit: AdjustedRig, tracks: PointTracks, priors: RigPriors, scale: float, free: Collection[str]
) -> np.ndarray:
    """Estimate (C,) how much the cost would fall if each camera alone joined the `free` ones.

    The estimate is to first order, with all points following; 0 for cameras that are free already.
    """
    rig = [fit.cameras[name] for name in tracks.names]
    normal = _eliminate_points(_linearise(rig, tracks, fit.points), tracks, scale, len(rig), 0.0)
    H = normal.cameras + np.diag(_information(rig, priors, None)[0].reshape(-1))
    pose = [UNKNOWNS * i + np.arange(6) for i in range(len(rig))]
    already = [tracks.names.index(name) for name in free]
    gains = np.zeros(len(rig))
    for index in set(range(len(rig))) - set(already):
        columns = np.concatenate([pose[i] for i in (*already, index)])
        step = np.linalg.solve(H[np.ix_(columns, columns)], normal.right[columns])
        gains[index] = 0.5 * normal.right[pose[index]] @ step[-6:]
    return gains


def triangulate_tracks(cameras: Mapping[str, Camera], tracks: PointTracks) -> np.ndarray:
    """Triangulate (P, 3) the points nearest to their rays, reweighted robustly in three rounds."""
    rig = [cameras[name] for name in tracks.names]
    xy = np.zeros_like(tracks.pixels)
    for index, camera in enumerate(rig):
        mine = tracks.camera == index
        xy[mine] = np.nan_to_num(normalised(camera, tracks.pixels[mine]))
    pose = np.stack([camera.cam_from_world for camera in rig])[tracks.camera]
    focal = np.array([camera.focal for camera in rig])[tracks.camera] / tracks.sigma
    d = np.einsum("nji,nj->ni", pose[:, :3, :3], np.column_stack([xy, np.ones(len(xy))]))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    centre = -np.einsum("nji,nj->ni", pose[:, :3, :3], pose[:, :3, 3])
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    weight = focal**2
    count = int(tracks.point.max(initial=-1)) + 1
    for _ in range(3):
        A = _sum_by(weight[:, None, None] * across, tracks.point, count)
        right = np.einsum("nij,nj->ni", across, centre) * weight[:, None]
        right = _sum_by(right, tracks.point, count)
        trace = np.trace(A, axis1=1, axis2=2)[:, None, None]
        points = np.linalg.solve(A + 1e-9 * trace * np.eye(3), right[..., None])[..., 0]
        gap = np.einsum("nij,nj->ni", across, points[tracks.point] - centre)
        reach = np.maximum(np.linalg.norm(points[tracks.point] - centre, axis=1), 1e-6)
        angle = np.linalg.norm(gap, axis=1) / reach * focal
        weight = (focal / reach) ** 2 / (1 + (angle / 3) ** 2)
    return points


def move_pose(cam_from_world: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Apply a small rotation and translation (6,), in the camera's axes, to a pose (4, 4)."""
    return make_transform(axis_angle_to_matrix(step[:3]), step[3:]) @ cam_from_world


def _lens(camera: Camera) -> np.ndarray:
    """Return the unknowns (4,) of a camera's lens: those from the log focal length on."""
    return np.array([np.log(camera.focal), *camera.K[:2, 2], camera.dist[0]])


def _has_bend(camera: Camera) -> bool:
    return "k1" in MODELS[camera.model]


def _moved(camera: Camera, step: np.ndarray) -> Camera:
    """Apply a step (10,) of its unknowns to a camera."""
    p = dict(zip(MODELS[camera.model], camera.params, strict=True))
    for name in p.keys() & {"f", "fx", "fy"}:
        p[name] *= float(np.exp(np.clip(step[6], -0.5, 0.5)))
    for name, change in zip(("cx", "cy", "k1"), step[7:], strict=True):
        if name in p:
            p[name] += float(change)
    pose = move_pose(camera.cam_from_world, step[:6])
    return replace(camera, params=tuple(p.values()), cam_from_world=pose)


def _information(
    rig: list[Camera], priors: RigPriors, free: Collection[str] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the inverse variances (C, 10) of the unknowns, and the flat indices of free ones."""
    sigma = np.zeros((len(rig), UNKNOWNS))
    for row, camera in zip(sigma, rig, strict=True):
        if free is None or camera.id in free:
            diagonal = float(np.hypot(camera.width, camera.height))
            row[:3], row[3:6], row[6] = priors.turn_rad, priors.move_m, priors.focal
            row[7:9] = priors.centre * diagonal
            row[9] = _has_bend(camera) * priors.bend / (diagonal / 2 / camera.focal) ** 2
    information = np.zeros_like(sigma)
    information[sigma > 0] = sigma[sigma > 0] ** -2.0
    return information, np.flatnonzero(sigma)


def _ties(rig: list[Camera], priors: RigPriors) -> np.ndarray:
    """Return the information (C, C) that ties log focal lengths of pictures of one size."""
    sizes = np.array([(camera.width, camera.height) for camera in rig])
    alike = (sizes[:, None] == sizes).all(2)
    ties = np.eye(len(rig)) - alike / alike.sum(1)
    free = priors.focal > 0 and np.isfinite(priors.focal_spread)
    return ties / priors.focal_spread**2 if free else np.zeros_like(ties)


def _linearise(rig: list[Camera], tracks: PointTracks, points: np.ndarray) -> _Linear:
    count = len(tracks.pixels)
    by_camera, by_point = np.zeros((count, 2, UNKNOWNS)), np.zeros((count, 2, 3))
    errors, ahead = np.zeros((count, 2)), np.zeros(count, bool)
    for index, camera in enumerate(rig):
        mine = np.flatnonzero(tracks.camera == index)
        R, t = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
        local = points[tracks.point[mine]] @ R.T + t
        ahead[mine] = local[:, 2] > 1e-3
        z = np.where(ahead[mine], local[:, 2], 1.0)
        xy = np.clip(local[:, :2] / z[:, None], -5, 5)
        focal = camera.K[[0, 1], [0, 1]]
        bent, step = distort(camera, xy), 1e-6
        errors[mine] = bent * focal + camera.K[:2, 2] - tracks.pixels[mine]
        along, cross, down = distortion_slopes(camera.dist, xy)
        plane = np.stack([along, cross, cross, down], axis=1).reshape(-1, 2, 2) * focal[:, None]
        by_local = np.concatenate([plane, -np.einsum("nij,nj->ni", plane, xy)[..., None]], axis=2)
        by_local /= z[:, None, None]
        by_point[mine] = by_local @ R
        by_camera[mine, :, :3] = np.cross(local[:, None, :], by_local)  # of a turn w: w x local
        by_camera[mine, :, 3:6] = by_local
        by_camera[mine, :, 6] = bent * focal
        by_camera[mine[:, None], [0, 1], [7, 8]] = 1.0
        if _has_bend(camera):
            nudged = _moved(camera, step * np.eye(UNKNOWNS)[9])
            by_camera[mine, :, 9] = (distort(nudged, xy) - bent) * (focal / step)
    sizes = np.where(ahead, np.linalg.norm(errors, axis=1) / tracks.sigma, BEHIND)
    by_camera[~ahead], by_point[~ahead] = 0.0, 0.0
    return _Linear(errors, by_camera, by_point, sizes)


class Normal(NamedTuple):
    """Normal equations of C cameras with K unknowns, from which G groups with M are eliminated.

    Source: Triggs et al., section 6.1.
    """

    cameras: np.ndarray
    right: np.ndarray
    diagonal: np.ndarray  # (C K,) the full system's, the rest the reduced one's
    follow: Callable[[np.ndarray], np.ndarray]  # the groups' steps (G, M) after a step (C K,)


def _eliminate_points(
    at: _Linear, tracks: PointTracks, scale: float, cameras: int, damping: float
) -> Normal:
    root = (1 / tracks.sigma / np.sqrt(1 + (at.sizes / scale) ** 2))[:, None]
    by_camera, by_point = at.by_camera * root[..., None], at.by_point * root[..., None]
    return eliminate(
        by_camera, by_point, at.errors * root, tracks.camera, tracks.point, cameras, damping
    )


def eliminate(
    by_camera: np.ndarray,
    by_group: np.ndarray,
    errors: np.ndarray,
    camera: np.ndarray,
    group: np.ndarray,
    cameras: int,
    damping: float = 0.0,
) -> Normal:
    """Eliminate the unknowns that groups of observations share: points, or the board's poses.

    `errors` (N, 2) are weighted and derived by the unknowns of the observation's camera (N, 2, K)
    and group (N, 2, M); `camera` and `group` (N,) number these. `damping` times the groups'
    diagonal is added.
    """
    total, each, size = int(group.max(initial=-1)) + 1, by_camera.shape[2], by_group.shape[2]
    V = _sum_by(by_group.transpose(0, 2, 1) @ by_group, group, total)
    V += damping * V * np.eye(size)
    V += 1e-9 * (1 + np.trace(V, axis1=1, axis2=2))[:, None, None] * np.eye(size)
    # In this order: the inverse of a matrix that is nearly singular may round to an indefinite one.
    root = np.linalg.inv(np.linalg.cholesky(V)).transpose(0, 2, 1)
    mixed = by_camera.transpose(0, 2, 1) @ (by_group @ root[group])
    blocks = _sum_by(mixed, camera * total + group, total * cameras)
    blocks = blocks.reshape(cameras, total, each, size).transpose(0, 2, 1, 3)
    coupling = blocks.reshape(cameras * each, total * size)
    pull = _sum_by(np.einsum("nki,nk->ni", by_group, errors), group, total)
    pull = (pull[:, None] @ root).reshape(-1)
    push = _sum_by(np.einsum("nki,nk->ni", by_camera, errors), camera, cameras).reshape(-1)
    own = np.arange(cameras)
    squares = np.zeros((cameras, each, cameras, each))
    squares[own, :, own] = _sum_by(by_camera.transpose(0, 2, 1) @ by_camera, camera, cameras)
    full = squares.reshape(cameras * each, cameras * each)

    def follow(step: np.ndarray) -> np.ndarray:
        moved = (pull + step @ coupling).reshape(total, size, 1)
        return -(root @ moved)[..., 0]

    return Normal(
        cameras=full - coupling @ coupling.T,
        right=coupling @ pull - push,
        diagonal=np.diag(full).copy(),
        follow=follow,
    )


def _sum_by(rows: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """Sum (count, ...) of rows (N, ...) by their group (N,)."""
    table = csr_array((np.ones(len(rows)), (group, np.arange(len(rows)))), (count, len(rows)))
    flat = rows.reshape(len(rows), int(np.prod(rows.shape[1:])))
    return (table @ flat).reshape(count, *rows.shape[1:])
