"""Intersect silhouettes: the visual hull, the box around it, and the camera that contradicts it."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from express50.contract.stage import Note
from express50.errors import StageError
from express50.files.images import resize_area
from express50.geometry.cameras import project
from express50.geometry.conventions import cell_to_corner
from express50.geometry.sampling import bilinear
from pipelines.depth.views import INSIDE, DepthView, project_fast

UNSEEN = 1.0  # metres; the distance given to space that too few cameras see
BOX_CELLS = 40  # along the sides of the box in which the hull is looked for
VOTERS = 5  # fewest views of which one can be outvoted
MISSED = 0.001  # share of the mattes that the hull may miss before any view is suspected
OUTVOTED = 2.0  # leaving the view out must help this many times more than leaving out any other
CELLS = 64  # along the sides of the box in which views are compared


def hull_distance(views: Sequence[DepthView], points: np.ndarray) -> np.ndarray:
    """Measure signed distances (N,) of points (N, 3) to the visual hull, metres, negative inside.

    Each view bounds the distance by its silhouette's, scaled from pixels to metres at the point's
    depth; the hull is the intersection, hence the maximum (Laurentini 1994). Points seen by fewer
    than two views, or by less than a third of them, are outside: otherwise phantoms would float
    in front of the head.
    """
    distance = np.full(len(points), -UNSEEN, np.float32)
    seen = np.zeros(len(points), np.int16)
    for view in views:
        camera = view.camera
        pixels, depth = project_fast(camera, points)
        inside = (
            (depth > 0)
            & (pixels[:, 0] >= 0)
            & (pixels[:, 0] <= camera.width)
            & (pixels[:, 1] >= 0)
            & (pixels[:, 1] <= camera.height)
        )
        focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
        metres = -bilinear(view.silhouette_px, pixels[inside]) * depth[inside] / focal
        distance[inside] = np.maximum(distance[inside], metres)
        seen += inside
    return np.where(seen >= max(2, len(views) / 3), distance, UNSEEN).astype(np.float32)


def head_box(views: Sequence[DepthView]) -> tuple[np.ndarray, np.ndarray]:
    """Find the corners (3,), (3,) of the box around the visual hull, metres.

    Raises:
        StageError: the silhouettes have no common volume.
    """
    center = _meeting_point(views)
    radius = np.full(3, max(_extent(view, center) for view in views))
    for _ in range(2):
        axis = np.linspace(-1.0, 1.0, BOX_CELLS)
        cube = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
        points = center + radius * cube
        step = 2.0 * radius / (BOX_CELLS - 1)
        inside = points[hull_distance(views, points) < 0.5 * step.max()]
        if not len(inside):
            raise StageError(
                f"the silhouettes of {len(views)} cameras share no volume around {center.round(3)};"
                " expected mattes of one head in one world: check mattes and calibration"
            )
        low, high = inside.min(0) - step, inside.max(0) + step
        radius = (high - low) / 2.0
        center = low + radius
    return center - radius, center + radius


def _meeting_point(views: Sequence[DepthView]) -> np.ndarray:
    """Find the point (3,) nearest to the rays through the mattes' centres."""
    A, b, origins = np.zeros((3, 3)), np.zeros(3), []
    for view in views:
        y, x = np.nonzero(view.alpha > INSIDE)
        K, R = view.camera.K, view.camera.cam_from_world[:3, :3]
        middle = cell_to_corner(np.array([x.mean(), y.mean()]))
        ray = np.r_[(middle - K[:2, 2]) / K[[0, 1], [0, 1]], 1.0]
        ray = R.T @ ray / np.linalg.norm(ray)
        plane = np.eye(3) - np.outer(ray, ray)
        A, b = A + plane, b + plane @ view.camera.center
        origins.append(view.camera.center)
    scale = np.linalg.norm(np.std(origins, axis=0))
    if scale < 1e-6 or np.linalg.eigvalsh(A)[0] < 1e-4:
        raise StageError(
            f"{len(views)} cameras look along one line; expected two directions at least a degree"
            " apart: check the calibration"
        )
    return np.linalg.solve(A, b)


def _extent(view: DepthView, center: np.ndarray) -> float:
    """Measure the largest distance, metres, of the matte's pixels from ``center`` (3,)."""
    pixels, depth = project(view.camera, center[None])
    y, x = np.nonzero(view.alpha > INSIDE)
    offset = cell_to_corner(np.stack([x, y], axis=1)) - pixels[0]
    if depth[0] <= 0 or not np.isfinite(offset).all():
        raise StageError(
            f"camera {view.camera.id}: the head lies behind it; expected every camera to face the"
            " head: check the calibration"
        )
    return float(1.1 * np.linalg.norm(offset, axis=1).max() * depth[0] / view.camera.K[0, 0])


@dataclass(frozen=True)
class _Vote:
    """What a view says about cells of space.

    Attributes:
        allows: (P,) false where the view rules the cell out: it sees it outside its matte.
        pixel: (P,) flat pixel of the cell in ``matte``, -1 where unseen.
        matte: (h, w) bool, about one pixel per cell.
    """

    allows: np.ndarray
    pixel: np.ndarray
    matte: np.ndarray


def without_contradiction(views: Sequence[DepthView]) -> tuple[list[DepthView], list[Note]]:
    """Leave out the one view, if any, whose matte contradicts the others, and say so.

    A matte that misses half of the head, or a camera that is elsewhere than its calibration says,
    carves the common hull away: the hull no longer fills the mattes, but does without that view.
    """
    if len(views) < VOTERS:
        return list(views), []
    low, high = _box_despite_one(views)
    axes = [np.linspace(a, b, CELLS) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    cell = float((high - low).max() / (CELLS - 1))
    votes = [_vote(view, points, cell) for view in views]
    missed = _unfilled(votes)
    if missed < MISSED:
        return list(views), []
    without = [_unfilled([*votes[:k], *votes[k + 1 :]]) for k in range(len(views))]
    worst = int(np.argmin(without))
    second = float(np.sort(without)[1])
    if without[worst] > second / OUTVOTED or second < MISSED / 2:
        return list(views), []
    why = (
        f"it contradicts the others (the common hull misses {missed:.1%} of the mattes with it,"
        f" {without[worst]:.1%} without it): check its matte and its calibration"
    )
    return [v for k, v in enumerate(views) if k != worst], [Note(views[worst].camera.id, why)]


def _box_despite_one(views: Sequence[DepthView]) -> tuple[np.ndarray, np.ndarray]:
    """Find a box (3,), (3,) that holds the hull of the views without any one of them, metres.

    It is the larger of the boxes of every second view each: a bad view spoils only one of them.
    """
    boxes = []
    for half in (views[0::2], views[1::2]):
        with contextlib.suppress(StageError):
            boxes.append(head_box(half))
    return max(boxes or [head_box(views)], key=lambda box: float(np.prod(box[1] - box[0])))


def _vote(view: DepthView, points: np.ndarray, cell: float) -> _Vote:
    """Let a view judge cells of ``cell`` metres around points (P, 3)."""
    pixels, depth = project_fast(view.camera, points)
    size = np.array([view.camera.width, view.camera.height])
    seen = (depth > 0) & (pixels >= 0).all(1) & (pixels < size).all(1)
    near = float(np.median(depth[seen])) if seen.any() else 1.0
    step = max(1.0, cell * view.camera.K[0, 0] / near)
    shape = np.maximum(1, np.ceil(size / step)).astype(int)
    allows = np.ones(len(points), bool)
    allows[seen] = bilinear(view.silhouette_px, pixels[seen]) > -step / 2
    column, row = np.minimum((pixels[seen] / step).astype(int), shape - 1).T
    pixel = np.full(len(points), -1)
    pixel[seen] = row * shape[0] + column
    small = resize_area(view.silhouette_px, int(shape[0]), int(shape[1]))
    return _Vote(allows, pixel, small > 0)


def _unfilled(votes: Sequence[_Vote]) -> float:
    """Measure the share of the mattes, mean over the views, that their hull does not fill."""
    hull = np.stack([vote.allows for vote in votes]).all(0)
    shares = []
    for vote in votes:
        filled = np.zeros(vote.matte.size, np.uint8)
        filled[vote.pixel[hull & (vote.pixel >= 0)]] = 1
        filled = cv2.dilate(filled.reshape(vote.matte.shape), np.ones((3, 3), np.uint8))
        shares.append(float((filled[vote.matte] == 0).mean()) if vote.matte.any() else 0.0)
    return float(np.mean(shares))
