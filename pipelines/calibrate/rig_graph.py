"""First guess of a rig: relative poses through shared board frames, joined over the best tree.

Each camera has, for each frame, the board poses its view allows (two, since a flat target is
ambiguous). A pair of cameras agrees on one relative pose over all its shared frames, which
resolves the ambiguity and reveals cameras that are not synchronised.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from express50.geometry.cameras import Camera
from express50.geometry.transforms import (
    invert_transform,
    make_transform,
    matrix_to_axis_angle,
)
from pipelines.calibrate.board import even
from pipelines.calibrate.intrinsics import BoardView

NEAR = 0.02
"""Largest error of a predicted board, as a share of the image's diagonal: generous, because both
poses come from one view each with rough intrinsics."""

Poses = Mapping[str, Mapping[int, list[np.ndarray]]]
Views = Mapping[str, Mapping[int, BoardView]]


def mean_transform(transforms: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Average transforms (N, 4, 4): chordal mean of the rotations, mean of the translations."""
    U, _, Vt = np.linalg.svd(np.tensordot(weights, transforms[:, :3, :3], 1))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return make_transform(R, weights @ transforms[:, :3, 3] / weights.sum())


def _pose_error(cam_from_board: np.ndarray, view: BoardView, focal: float) -> float:
    """Rms distance, pixels, of a view's corners from where a pose puts them (inf if behind)."""
    placed = view.points @ cam_from_board[:3, :3].T + cam_from_board[:3, 3]
    if placed[:, 2].min() <= 0:
        return float("inf")
    error = placed[:, :2] / placed[:, 2:] - view.ideal
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1)))) * focal


def relative_pose(
    camera: Camera,
    views: Mapping[int, BoardView],
    from_poses: Mapping[int, list[np.ndarray]],
    to_poses: Mapping[int, list[np.ndarray]],
) -> tuple[np.ndarray, float] | None:
    """Find the pose to_from_from (4, 4) on which shared frames agree, and its weight in corners.

    `camera` and `views` are those of the camera the pose leads to. Every combination in a frame
    is a candidate; the one that predicts most corners in the other frames wins and is averaged
    with those near it. Returns None if it explains less than half of the frames.
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
    tested = [shared[i] for i in even(len(shared), 30)]
    near = NEAR * float(np.hypot(camera.width, camera.height))
    predict = _predictor([views[f] for f in tested], [from_poses[f] for f in tested], camera)
    # Candidates are alike between frames: a fixed, even sample keeps the search small.
    sample = [candidates[i] for i in even(len(candidates), 80)]
    errors = np.stack([predict(candidate) for candidate in sample])
    best = int(np.argmin(np.minimum(errors, near).sum(1)))
    agreed = float(np.mean(errors[best] < near))
    if agreed < 0.5:
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
    ideal = np.concatenate([view.ideal for view in views])
    focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    # One stack of points per alternative; a view with a single pose repeats it.
    stacks = [
        np.concatenate(
            [
                v.points @ p[min(i, len(p) - 1)][:3, :3].T + p[min(i, len(p) - 1)][:3, 3]
                for v, p in zip(views, poses, strict=True)
            ]
        )
        for i in range(2)
    ]

    def predict(pose: np.ndarray) -> np.ndarray:
        errors = []
        for stack in stacks:
            placed = stack @ pose[:3, :3].T + pose[:3, 3]
            ahead = np.where(placed[:, 2:] > 0, placed[:, 2:], 1e-9)
            squared = np.sum((placed[:, :2] / ahead - ideal) ** 2, axis=1)
            errors.append(np.sqrt(np.add.reduceat(squared, starts) / counts) * focal)
        return np.minimum(*errors)

    return predict


def _nearness(pose: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Robust weights (N,) of other poses; a quarter at 2 degrees or 5 % of the pose's distance."""
    angles = np.linalg.norm(matrix_to_axis_angle(pose[:3, :3].T @ others[:, :3, :3]), axis=1)
    shifts = np.linalg.norm(others[:, :3, 3] - pose[:3, 3], axis=1)
    scale = max(float(np.linalg.norm(pose[:3, 3])), 1e-3)
    distances = angles / np.radians(2.0) + shifts / (0.05 * scale)
    return 1.0 / (1.0 + distances**2) ** 2


def pair_edges(
    cameras: Mapping[str, Camera], views: Views, poses: Poses
) -> dict[tuple[str, str], tuple[np.ndarray, float]]:
    """Find relative poses b_from_a and weights of all pairs (a, b), a before b, that agree."""
    names = sorted(cameras)
    edges = {}
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            found = relative_pose(cameras[b], views[b], poses[a], poses[b])
            if found is not None:
                edges[a, b] = found
    return edges


def join_rig(
    names: list[str], edges: Mapping[tuple[str, str], tuple[np.ndarray, float]], sweeps: int = 20
) -> dict[str, np.ndarray]:
    """Place the largest connected group of cameras: poses cam_from_rig (4, 4).

    The maximum spanning tree (Kruskal) by shared corners gives the poses, then sweeps of
    averaging over all edges spread the error of closing loops.
    """
    group = {name: name for name in names}
    tree: dict[str, list[tuple[str, np.ndarray]]] = {name: [] for name in names}
    for (a, b), (b_from_a, _) in sorted(edges.items(), key=lambda item: (-item[1][1], item[0])):
        if group[a] == group[b]:
            continue
        tree[a].append((b, b_from_a))
        tree[b].append((a, invert_transform(b_from_a)))
        old, new = group[b], group[a]
        group = {name: new if g == old else g for name, g in group.items()}
    sizes = {g: sum(1 for other in group.values() if other == g) for g in group.values()}
    largest = max(sorted(sizes), key=lambda g: sizes[g])
    root = min(name for name in names if group[name] == largest)
    poses = {root: np.eye(4)}
    queue = [root]
    while queue:
        at = queue.pop(0)
        for other, other_from_at in tree[at]:
            if other not in poses:
                poses[other] = other_from_at @ poses[at]
                queue.append(other)
    for _ in range(sweeps):
        for name in sorted(set(poses) - {root}):
            votes, weights = [], []
            for (a, b), (b_from_a, weight) in sorted(edges.items()):
                if name == b and a in poses:
                    votes.append(b_from_a @ poses[a])
                elif name == a and b in poses:
                    votes.append(invert_transform(b_from_a) @ poses[b])
                else:
                    continue
                weights.append(weight)
            stack = np.stack(votes)
            near = _nearness(poses[name], stack)
            poses[name] = mean_transform(stack, np.array(weights) * near)
    return poses


def rig_from_board(
    frame: int,
    cam_from_rig: Mapping[str, np.ndarray],
    cameras: Mapping[str, Camera],
    views: Views,
    poses: Poses,
) -> np.ndarray | None:
    """Choose the board's pose (4, 4) in one frame: the candidate that fits its cameras best."""
    seen = [name for name in sorted(cam_from_rig) if frame in poses[name]]
    best, lowest = None, float("inf")
    for name in seen:
        for pose in poses[name][frame]:
            candidate = invert_transform(cam_from_rig[name]) @ pose
            # The median keeps one bad camera from choosing the pose of all.
            errors = [
                _pose_error(cam_from_rig[o] @ candidate, views[o][frame], cameras[o].K[0, 0])
                for o in seen
            ]
            error = float(np.median(errors))
            if error < lowest:
                best, lowest = candidate, error
    return best
