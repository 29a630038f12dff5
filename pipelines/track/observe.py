"""Find the landmarks of a frame set on which its cameras agree."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from express50.geometry.cameras import Camera, project_pinhole, project_with_slope, triangulate
from express50.geometry.transforms import similarity_fit, unit
from express50.landmarks.irises import Irises
from pipelines.calibrate.footage_rig import INNER, mean_landmarks, pose_of_face

PAIR_LIMIT = 120
LANDMARK_FLOOR_PX = 1.0  # least error assumed of a landmark, for a face 128 px tall
# Landmarks 0..16 slide along the jaw; in a single view the jaw's width depends on them alone.
JAW_LINE_WEIGHT, SINGLE_VIEW_JAW_WEIGHT = 0.25, 0.7
INLIER_SIGMA = 3.5
MIN_SHARE = 0.4  # share of a view's known landmarks that must agree for it to stay
# Largest standard deviation, as a share of the face, so that vague landmarks can disagree too.
SIGMA_SHARE_LIMIT = 0.04
LEAST_POINTS = 12  # landmarks on which cameras agree, to place a head by
# Cameras whose lines of sight to the face differ by less than about this angle see the same.
SAME_DIRECTION = np.radians(2.0)


@dataclass(frozen=True)
class LandmarkView:
    """Landmarks seen by one pinhole camera."""

    camera: Camera
    points: np.ndarray  # (68, 2) pixels
    sigma: np.ndarray  # (68,) pixels; infinite where a point is not known
    score: float  # of the face, 0 to 1
    irises: Irises | None = None  # iris centres, where they were looked for
    # number of cameras, itself included, that look at the face from the same direction. They err
    # alike and count together as one.
    redundancy: float = 1.0
    # points 0..16 mark the visible edge of the jaw, as people's marks do, not fixed places of the
    # skin
    visible_contour: bool = False

    @property
    def camera_id(self) -> str:
        """Return the camera's id."""
        return self.camera.id

    @property
    def doubt(self) -> float:
        """Return how badly the view shows the face, to compare views: pixels over the score."""
        return float(np.median(self.sigma)) / self.score


@dataclass(frozen=True)
class Observation:
    """Views of one expression at one frame."""

    expression: str
    frame: int  # decode index
    views: tuple[LandmarkView, ...]  # views that are used
    inliers: np.ndarray  # (views, 68) bool, landmarks that agree with the other views
    points: np.ndarray  # (68, 3) triangulated, metres in the world; NaN where under two views agree
    covariance: np.ndarray  # (68, 3, 3) of the points, square metres; NaN with them
    shut: tuple[int, ...] = ()  # eyes that are known to be shut, as indices of `iris.EYES`


def triangulate_views(
    expression: str, frame: int, views: list[LandmarkView]
) -> tuple[Observation, list[str]]:
    """Triangulate robustly; leave out whole views that disagree, and return their ids too."""
    refused: list[str] = []
    views = with_redundancy(views)
    while True:
        points, inliers = robust_triangulate(views)
        known = np.stack([np.isfinite(view.sigma) for view in views])
        share = (inliers & known).sum(1) / np.maximum(known.sum(1), 1)
        if len(views) <= 2 or share.min() >= MIN_SHARE:
            used = inliers & known
            covariance = point_covariance(views, points, used)
            found = Observation(expression, frame, tuple(views), used, points, covariance)
            return found, refused
        worst = int(np.argmin(share))
        refused.append(views[worst].camera_id)
        views = views[:worst] + views[worst + 1 :]


def with_redundancy(views: list[LandmarkView]) -> list[LandmarkView]:
    """Set the `redundancy` of views: cameras within about SAME_DIRECTION count as one."""
    if len(views) < 2:
        return views
    middle = [view.points[np.isfinite(view.sigma)].mean(0) for view in views]
    rays = np.stack([_rays(v, m[None])[0] for v, m in zip(views, middle, strict=True)])
    angle = np.arccos(np.clip(rays @ rays.T, -1.0, 1.0))
    redundancy = np.exp(-0.5 * (angle / SAME_DIRECTION) ** 2).sum(1)
    return [replace(view, redundancy=float(c)) for view, c in zip(views, redundancy, strict=True)]


def robust_triangulate(views: list[LandmarkView]) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate landmarks by consensus over pairs of views: points (68, 3), inliers (views, 68).

    Every pair gives a candidate point; the one with the lowest truncated squared error over all
    views wins, its inliers are triangulated again, weighted by 1 / sigma^2. Points are NaN where
    under two views agree. With fewer than two views all landmarks count as inliers and no point is
    triangulated.
    """
    count = len(views)
    if count < 2:
        return np.full((68, 3), np.nan), np.ones((count, 68), dtype=bool)
    candidates = _pair_points(views)
    squared = np.empty((len(candidates), count, 68))  # over sigma; infinite behind a camera
    for index, view in enumerate(views):
        pixels, depth = project_pinhole(view.camera, candidates)
        limit = SIGMA_SHARE_LIMIT * float(np.ptp(view.points, axis=0).max())
        error = ((pixels - view.points) ** 2).sum(-1) / np.minimum(view.sigma, limit) ** 2
        squared[:, index] = np.where(depth > 0, error, np.inf)
    redundancy = np.array([view.redundancy for view in views])
    cost = (np.minimum(squared, INLIER_SIGMA**2) / redundancy[:, None]).sum(1)
    best = np.argmin(cost, axis=0)
    columns = np.arange(68)
    inliers = squared[best, :, columns].T < INLIER_SIGMA**2
    pixels = np.stack([view.points for view in views])
    weights = np.stack([1.0 / (view.redundancy * view.sigma**2) for view in views])
    points = triangulate([view.camera for view in views], pixels, weights * inliers)
    return points, inliers


def place_head(views: list[LandmarkView]) -> tuple[float, np.ndarray, np.ndarray] | None:
    """Place the mean head by all views of a face, or by the best one; None if that fails.

    The scale, rotation (3, 3) and shift (3,) mean: world = scale * rotation @ head + shift.
    """
    points, _ = robust_triangulate(views)
    head, known = mean_landmarks(), np.isfinite(points[INNER]).all(1)
    if known.sum() >= LEAST_POINTS:
        return similarity_fit(head[INNER][known], points[INNER][known])
    for view in sorted(views, key=lambda view: -view.score):
        pose, error = pose_of_face(view.points, view.sigma, view.camera, head)
        if np.isfinite(error):
            world = np.linalg.inv(view.camera.cam_from_world) @ pose
            return 1.0, world[:3, :3], world[:3, 3]
    return None


def point_covariance(
    views: list[LandmarkView], points: np.ndarray, inliers: np.ndarray
) -> np.ndarray:
    """Return the covariance (68, 3, 3) of points (68, 3) triangulated from inliers (C, 68), m^2.

    The inverse of the normal equations at the points: each view adds J' J / (redundancy sigma^2), J
    (2, 3) being the slope of its pixel and sigma the standard deviation of a coordinate.
    """
    normal = np.zeros((68, 3, 3))
    known = np.isfinite(points).all(1)
    for view, used in zip(views, inliers, strict=True):
        chosen = np.flatnonzero(used & known & np.isfinite(view.sigma))
        _, slope = project_with_slope(view.camera, points[chosen])
        weight = 1.0 / (view.redundancy * view.sigma[chosen] ** 2)
        normal[chosen] += weight[:, None, None] * np.swapaxes(slope, 1, 2) @ slope
    covariance = np.full((68, 3, 3), np.nan)
    solid = known & (np.linalg.cond(normal) < 1e12)
    covariance[solid] = np.linalg.inv(normal[solid])
    return covariance


def landmark_sigma(observation: Observation) -> np.ndarray:
    """Return standard deviations (views, 68) in pixels, infinite where a landmark is not used."""
    sigma = np.empty((len(observation.views), 68))
    for index, view in enumerate(observation.views):
        height = np.ptp(view.points[17:], axis=0).max()
        floor = LANDMARK_FLOOR_PX * height / 128.0
        sigma[index] = np.hypot(view.sigma, floor) * view.redundancy**0.5
    single = len(observation.views) == 1
    sigma[:, :17] /= SINGLE_VIEW_JAW_WEIGHT if single else JAW_LINE_WEIGHT
    return np.where(observation.inliers, sigma, np.inf)


def facing(view: LandmarkView, rotation: np.ndarray, translation: np.ndarray) -> float:
    """Return the cosine between the face's forward direction and the direction to a camera.

    The head is at world = rotation @ head + translation; it looks along +z.
    """
    towards = view.camera.center - translation
    return float(rotation[:, 2] @ towards / max(float(np.linalg.norm(towards)), 1e-9))


def _pair_points(views: list[LandmarkView]) -> np.ndarray:
    """Return midpoints (pairs, 68, 3) of closest approach of the rays of pairs of views."""
    origins = [view.camera.center for view in views]
    directions = [_rays(view, view.points) for view in views]
    pairs = list(combinations(range(len(views)), 2))
    if len(pairs) > PAIR_LIMIT:
        # The surest views first: their pairs span the rig well enough.
        order = np.argsort([view.doubt for view in views])
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


def _rays(view: LandmarkView, pixels: np.ndarray) -> np.ndarray:
    """Return unit world directions (N, 3) of pixels (N, 2) of a pinhole view."""
    K, pose = view.camera.K, view.camera.cam_from_world
    x = (pixels - K[:2, 2]) / K[[0, 1], [0, 1]]
    return unit(np.concatenate([x, np.ones((len(x), 1))], axis=1) @ pose[:3, :3])
