"""Guess a rig from board images: lenses, poses of single views, and how views join.

Each camera gets a lens from its own views, and for each frame the board poses that its view allows
(two, since a flat target is ambiguous). The relative pose on which two cameras agree over their
shared frames resolves the ambiguity and reveals cameras that are not synchronised. This only starts
the joint solution, so it must survive bad frames rather than be exact.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from express50.geometry.cameras import MODELS, Camera
from express50.geometry.sampling import evenly
from express50.geometry.transforms import (
    invert_transform,
    make_transform,
    matrix_to_axis_angle,
    transform_points,
)
from pipelines.calibrate.board import BoardCorners

MIN_CORNERS = 8  # that a board image needs to count
MIN_FRAMES = 4  # board images that a camera needs; one with fewer is dropped
NEAR = 0.02
"""Largest error of a predicted board, as a share of the image's diagonal: generous, because both
poses come from one view each with rough intrinsics."""


@dataclass(frozen=True)
class BoardView:
    """Corners of one board image."""

    frame: int
    points: np.ndarray  # (N, 3) metres
    pixels: np.ndarray  # (N, 2)
    # (N, 2) normalised, without distortion; empty until the camera is known
    ideal: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))


Poses = Mapping[str, Mapping[int, list[np.ndarray]]]
Views = Mapping[str, Mapping[int, BoardView]]


def seen_from_front(view: BoardView) -> bool:
    """Check the sense in which corners run round the board; mirrors and its back reverse it."""
    flat = np.column_stack([view.points[:, :2], np.ones(len(view.points))])
    affine, _, rank, _ = np.linalg.lstsq(flat, view.pixels, rcond=None)
    return bool(rank == 3 and np.linalg.det(affine[:2]) > 0)


def board_views(
    corners: BoardCorners, camera: str, points: np.ndarray, size: tuple[int, int]
) -> list[BoardView]:
    """List a camera's board images that hold a pose, in order of frame.

    Their corners spread over two directions and over more than 3 % of the diagonal of an image of
    `size` (width, height). `points` (P, 3) are the corners on the board.
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
    views: list[BoardView], size: tuple[int, int], model: str
) -> tuple[np.ndarray, np.ndarray, list[int]] | None:
    """Fit focal lengths, principal point and distortion to views of a flat board.

    Views that fit three times worse than the median view are set aside and the rest fitted
    again, at most three times. Returns K (3, 3), distortion (5,) in OpenCV's order and the
    indices of the views used, or None if fewer than `MIN_FRAMES` views agree.
    """
    use = list(range(len(views)))
    for _ in range(4):
        if len(use) < MIN_FRAMES:
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
    """Write K (3, 3) and OpenCV's distortion (4 or more,) in COLMAP's parameter order of `model`.

    Distortion that the model lacks is left out.
    """
    named = {"fx": K[0, 0], "fy": K[1, 1], "f": (K[0, 0] + K[1, 1]) / 2, "cx": K[0, 2]}
    named |= {"cy": K[1, 2]} | dict(zip(("k1", "k2", "p1", "p2"), dist, strict=False))
    return tuple(float(named[name]) for name in MODELS[model])


def as_model(camera: Camera, model: str) -> Camera:
    """Convert a camera to another model; distortion that the model lacks is left out."""
    return replace(camera, model=model, params=camera_params(camera.K, camera.dist, model))


def with_ideal(camera: Camera, view: BoardView) -> BoardView:
    """Add the normalised, undistorted coordinates of this camera to a view."""
    ideal = cv2.undistortPoints(view.pixels[:, None], camera.K, camera.dist[None])[:, 0]
    return replace(view, ideal=ideal)


def board_poses(view: BoardView) -> list[np.ndarray]:
    """List the poses cam_from_board (4, 4) that explain a view (with `ideal` set), best first.

    A small flat target has two that may reproject alike (IPPE, Collins and Bartoli 2014); only the
    other cameras can decide. The second is left out where it fits 2.5 times worse.
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
        if (errors := _view_errors(pose, view)) is not None:
            found.append((float(np.sqrt(np.mean(errors**2))), pose))
    found.sort(key=lambda item: item[0])
    limit = 2.5 * max(found[0][0], 1e-6) if found else 0.0
    return [pose for error, pose in found if error <= limit]


def all_board_poses(views: Views) -> dict[str, dict[int, list[np.ndarray]]]:
    """List the poses of all views that have one."""
    return {
        name: {frame: found for frame, view in mine.items() if (found := board_poses(view))}
        for name, mine in views.items()
    }


def mean_transform(transforms: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Average transforms (N, 4, 4): chordal mean of the rotations, mean of the translations."""
    U, _, Vt = np.linalg.svd(np.tensordot(weights, transforms[:, :3, :3], 1))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return make_transform(R, weights @ transforms[:, :3, 3] / weights.sum())


def relative_pose(
    camera: Camera,
    views: Mapping[int, BoardView],
    from_poses: Mapping[int, list[np.ndarray]],
    to_poses: Mapping[int, list[np.ndarray]],
) -> tuple[np.ndarray, float] | None:
    """Find the pose to_from_from (4, 4) on which shared frames agree, and its weight in corners.

    `camera` and `views` are those of the camera the pose leads to. The candidate that predicts most
    corners in other frames is averaged with those near it. None if it explains less than half of
    the frames, unless it explains a quarter and three. So a camera with bad images stays; one that
    is out of step explains only the frame that its pose is from.
    """
    shared = sorted(set(from_poses) & set(to_poses))
    candidates = [
        to @ invert_transform(from_)
        for f in shared
        for to in to_poses[f]
        for from_ in from_poses[f]
    ]
    if not candidates:
        return None
    tested = evenly(shared, 30)
    near = NEAR * float(np.hypot(camera.width, camera.height))
    predict = _predictor([views[f] for f in tested], [from_poses[f] for f in tested], camera)
    # Candidates are similar between frames: a fixed, even sample keeps the search small.
    sample = evenly(candidates, 80)
    errors = np.stack([predict(candidate) for candidate in sample])
    best = int(np.argmin(np.minimum(errors, near).sum(1)))
    agreed = float(np.mean(errors[best] < near))
    if agreed < 0.5 and (agreed < 0.25 or agreed * len(tested) < 3):
        return None
    weight = agreed * sum(len(views[f].points) for f in shared)
    stack = np.stack(candidates)
    return mean_transform(stack, _nearness(sample[best], stack)), weight


def _predictor(
    views: list[BoardView], poses: list[list[np.ndarray]], camera: Camera
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from a relative pose to its prediction's error (F,), pixels, per view."""
    counts = np.array([len(view.points) for view in views])
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    ideal, focal = np.concatenate([view.ideal for view in views]), camera.focal
    # One stack of points per alternative; a view with a single pose repeats it.
    stacks = [
        np.concatenate(
            [
                transform_points(p[min(i, len(p) - 1)], v.points)
                for v, p in zip(views, poses, strict=True)
            ]
        )
        for i in range(2)
    ]

    def predict(pose: np.ndarray) -> np.ndarray:
        errors = []
        for stack in stacks:
            placed = transform_points(pose, stack)
            ahead = np.where(placed[:, 2:] > 0, placed[:, 2:], 1e-9)
            squared = np.sum((placed[:, :2] / ahead - ideal) ** 2, axis=1)
            errors.append(np.sqrt(np.add.reduceat(squared, starts) / counts) * focal)
        return np.minimum(*errors)

    return predict


def _nearness(pose: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Weigh other poses (N,) robustly: a quarter at 2 degrees or 5 % of the pose's distance."""
    angles = np.linalg.norm(matrix_to_axis_angle(pose[:3, :3].T @ others[:, :3, :3]), axis=1)
    shifts = np.linalg.norm(others[:, :3, 3] - pose[:3, 3], axis=1)
    scale = max(float(np.linalg.norm(pose[:3, 3])), 1e-3)
    distances = angles / np.radians(2.0) + shifts / (0.05 * scale)
    return 1.0 / (1.0 + distances**2) ** 2


def join_rig(
    names: list[str], edges: Mapping[tuple[str, str], tuple[np.ndarray, float]], sweeps: int = 20
) -> dict[str, np.ndarray]:
    """Place the largest connected group of cameras: poses cam_from_rig (4, 4).

    `edges` are the pose b_from_a and weight of each pair (a, b). The maximum spanning tree gives
    the poses, then sweeps of averaging over all edges spread the error of closing loops.
    """
    steps = {**edges, **{(b, a): (invert_transform(T), w) for (a, b), (T, w) in edges.items()}}
    graph = np.zeros((len(names), len(names)))
    ordered = sorted(edges, key=lambda pair: (-edges[pair][1], pair))  # heaviest first
    for rank, (a, b) in enumerate(ordered, 1):
        graph[names.index(a), names.index(b)] = rank
    tree = minimum_spanning_tree(graph)
    group = connected_components(tree, directed=False)[1]
    root = int(np.flatnonzero(group == np.bincount(group).argmax())[0])
    order, before = breadth_first_order(tree, root, directed=False)
    poses = {names[root]: np.eye(4)}
    for i in order[1:]:
        a, b = names[before[i]], names[i]
        poses[b] = steps[a, b][0] @ poses[a]
    for _ in range(sweeps):
        for name in sorted(set(poses) - {names[root]}):
            tied = [other for other in sorted(poses) if (other, name) in steps]
            votes = np.stack([steps[other, name][0] @ poses[other] for other in tied])
            weights = np.array([steps[other, name][1] for other in tied])
            poses[name] = mean_transform(votes, weights * _nearness(poses[name], votes))
    return poses


def rig_from_boards(
    cam_from_rig: Mapping[str, np.ndarray],
    cameras: Mapping[str, Camera],
    views: Views,
    poses: Poses,
) -> dict[int, np.ndarray]:
    """Choose the board's pose (4, 4) in each frame: the candidate that fits its cameras best."""
    boards = {}
    for frame in sorted({f for name in cam_from_rig for f in poses[name]}):
        seen = [name for name in sorted(cam_from_rig) if frame in poses[name]]
        rig_from_cam = {name: invert_transform(cam_from_rig[name]) for name in seen}
        lowest = float("inf")
        for candidate in [rig_from_cam[n] @ pose for n in seen for pose in poses[n][frame]]:
            errors = []
            for n in seen:
                misses = _view_errors(cam_from_rig[n] @ candidate, views[n][frame])
                size = np.inf if misses is None else np.sqrt(np.mean(np.sum(misses**2, axis=1)))
                errors.append(size * cameras[n].K[0, 0])
            error = float(np.median(errors))  # one bad camera must not choose the pose of all
            if error < lowest:
                boards[frame], lowest = candidate, error
    return boards


def _view_errors(cam_from_board: np.ndarray, view: BoardView) -> np.ndarray | None:
    """Return a view's errors (K, 2) under a pose, normalised; None if it is behind the camera."""
    placed = transform_points(cam_from_board, view.points)
    if not np.isfinite(placed).all() or placed[:, 2].min() <= 0:
        return None
    return placed[:, :2] / placed[:, 2:] - view.ideal
