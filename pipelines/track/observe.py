"""Landmarks of one expression in all cameras, and which of them agree with each other."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from express50.cameras import Camera, triangulate

PAIR_LIMIT = 120
INLIER_SIGMA = 3.5
# However vague a landmark, one that is further off than this many shares of the face disagrees.
SIGMA_SHARE_LIMIT = 0.04


@dataclass(frozen=True)
class View:
    """Landmarks seen by one camera: points (68, 2) pixels, sigma (68,) pixels, face score."""

    camera_id: str
    camera: Camera
    points: np.ndarray
    sigma: np.ndarray
    score: float


@dataclass(frozen=True)
class Observation:
    """Views of one expression at one frame.

    Attributes:
        expression: expression id.
        frame: decode index.
        views: views that are used.
        inliers: (views, 68) bool, landmarks that agree with the other views.
        points: (68, 3) triangulated, metres in the world; NaN where under two views agree.
    """

    expression: str
    frame: int
    views: tuple[View, ...]
    inliers: np.ndarray
    points: np.ndarray


def agree(
    expression: str, frame: int, views: list[View], min_share: float = 0.4
) -> tuple[Observation, list[str]]:
    """Triangulate robustly and leave out whole views that disagree with the rest.

    Returns:
        The observation and the ids of the cameras left out.
    """
    refused: list[str] = []
    while True:
        points, inliers = robust_triangulate(views)
        share = inliers.mean(1) if len(views) > 2 else np.ones(len(views))
        if len(views) <= 2 or share.min() >= min_share:
            return Observation(expression, frame, tuple(views), inliers, points), refused
        worst = int(np.argmin(share))
        refused.append(views[worst].camera_id)
        views = views[:worst] + views[worst + 1 :]


def robust_triangulate(views: list[View]) -> tuple[np.ndarray, np.ndarray]:
    """Consensus over pairs of views, a landmark at a time.

    Every pair gives a candidate point; the one with the lowest truncated squared error over all
    views wins, its inliers are triangulated again, weighted by 1 / sigma^2.

    Returns:
        points (68, 3), NaN where under two views agree; inliers (views, 68) bool. With fewer than
        two views all landmarks count as inliers and no point is triangulated.
    """
    count = len(views)
    if count < 2:
        return np.full((68, 3), np.nan), np.ones((count, 68), dtype=bool)
    candidates = _pair_points(views)
    squared = _squared_errors(views, candidates)
    cost = np.minimum(squared, INLIER_SIGMA**2).sum(1)
    best = np.argmin(cost, axis=0)
    columns = np.arange(68)
    inliers = squared[best, :, columns].T < INLIER_SIGMA**2
    pixels = np.stack([view.points for view in views])
    weights = np.stack([1.0 / view.sigma**2 for view in views])
    points = triangulate([view.camera for view in views], pixels, weights * inliers)
    return points, inliers


def facing(view: View, rotation: np.ndarray, translation: np.ndarray) -> float:
    """Cosine between the face's forward direction and the direction to a camera.

    The head is at world = rotation @ head + translation; it looks along +z.
    """
    towards = view.camera.center - translation
    return float(rotation[:, 2] @ towards / max(float(np.linalg.norm(towards)), 1e-9))


def _pair_points(views: list[View]) -> np.ndarray:
    """Midpoints (pairs, 68, 3) of closest approach of the rays of pairs of views."""
    origins, directions = zip(*(_landmark_rays(view) for view in views), strict=True)
    pairs = list(combinations(range(len(views)), 2))
    if len(pairs) > PAIR_LIMIT:
        # The surest views first: their pairs span the rig well enough.
        order = np.argsort([np.median(view.sigma) / view.score for view in views])
        rank = np.argsort(order)
        pairs = sorted(pairs, key=lambda pair: rank[pair[0]] + rank[pair[1]])[:PAIR_LIMIT]
    midpoints = np.empty((len(pairs), 68, 3))
    for index, (i, j) in enumerate(pairs):
        a, b, w = directions[i], directions[j], origins[i] - origins[j]
        cosine = (a * b).sum(1)
        determinant = np.maximum(1.0 - cosine**2, 1e-9)
        along_a = (cosine * (b @ w) - a @ w) / determinant
        along_b = ((b @ w) - cosine * (a @ w)) / determinant
        midpoints[index] = 0.5 * (
            origins[i] + along_a[:, None] * a + origins[j] + along_b[:, None] * b
        )
    return midpoints


def _landmark_rays(view: View) -> tuple[np.ndarray, np.ndarray]:
    """Camera centre (3,) and unit directions (68, 3) of a pinhole view's landmarks."""
    K, pose = view.camera.K, view.camera.cam_from_world
    x = (view.points - K[:2, 2]) / K[[0, 1], [0, 1]]
    directions = np.concatenate([x, np.ones((68, 1))], axis=1) @ pose[:3, :3]
    return view.camera.center, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _squared_errors(views: list[View], candidates: np.ndarray) -> np.ndarray:
    """Squared reprojection errors over sigma (pairs, views, 68); infinite behind a camera."""
    errors = np.empty((len(candidates), len(views), 68))
    for index, view in enumerate(views):
        pixels, depth = project_pinhole(view.camera, candidates)
        limit = SIGMA_SHARE_LIMIT * float(np.ptp(view.points, axis=0).max())
        squared = ((pixels - view.points) ** 2).sum(-1) / np.minimum(view.sigma, limit) ** 2
        errors[:, index] = np.where(depth > 0, squared, np.inf)
    return errors


def project_pinhole(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (..., 2) and depth (...) of world points (..., 3) in an undistorted camera."""
    local = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    depth = local[..., 2]
    safe = np.where(np.abs(depth) > 1e-9, depth, 1e-9)
    return local[..., :2] / safe[..., None] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2], depth
