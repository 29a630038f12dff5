"""Prepare an item's cameras: mattes, distances to silhouettes, and the visual hull they share."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from express50.capture.frames import reduced
from express50.contract.segmentation_labels import label_mask
from express50.contract.stage import Note
from express50.errors import StageError
from express50.geometry.cameras import Camera, nearest_to_lines, project
from express50.geometry.conventions import cell_to_corner
from express50.geometry.pixels import box_about, resize_area
from express50.geometry.sampling import bilinear
from express50.geometry.transforms import is_rigid
from pipelines.regions.geometry import FACE, TrackedHead, render_head

INSIDE = 0.5  # alpha at a silhouette
EMPTY = 0.002  # share of the image below which a matte holds no head
FULL = 0.98  # share above which a matte cuts nothing out
SPECK = 0.01  # share of a matte's largest part below which other parts are dropped
HOLE = 0.05  # share of the matte up to which a hole in it is filled
LOST_M = 0.004  # metres inside the tracked outline, where an error of the track does not reach
UPSAMPLE = 3  # times that a matte is enlarged before distances to its outline are measured
ENLARGED_PX = 16  # up to so far around it; further away, a pixel's error does not matter
UNSEEN = 1.0  # metres; the distance given to space that too few cameras see
BOX_CELLS = 40  # along the sides of the box in which the hull is looked for
VOTERS = 5  # fewest views of which one can be outvoted
MISSED = 0.001  # share of the mattes that the hull may miss before any view is suspected
OUTVOTED = 2.0  # leaving the view out must help so many times more than leaving out any other
CELLS = 64  # along the sides of the box in which views are compared


@dataclass(frozen=True)
class DepthView:
    """One usable pinhole camera."""

    camera: Camera
    rgb: np.ndarray  # frame (H, W, 3) uint8 sRGB
    alpha: np.ndarray  # matte (H, W) in [0, 1]
    silhouette_px: np.ndarray  # (H, W) signed distance to the matte's outline, positive inside


def make_view(camera: Camera, rgb: np.ndarray, alpha: np.ndarray, side: int) -> DepthView:
    """Make a view of a pinhole camera's images, averaged down to at most ``side`` pixels.

    Raises:
        StageError: the camera cannot be used: sizes differ, or the matte is empty or full.
    """
    if rgb.shape[:2] != (camera.height, camera.width) or alpha.shape != rgb.shape[:2]:
        raise StageError(
            f"frame {rgb.shape[1]}x{rgb.shape[0]} and matte {alpha.shape[1]}x{alpha.shape[0]} are"
            f" not of the camera's size, {camera.width}x{camera.height}"
        )
    share = float((alpha > INSIDE).mean())
    if share < EMPTY:
        raise StageError(f"its matte is empty ({share:.2%} of the image)")
    if share > FULL:
        raise StageError(f"its matte covers {share:.1%} of the image and cuts nothing out")
    camera, rgb, alpha = reduced(camera, rgb, alpha, side)
    if not (alpha > INSIDE).any():
        raise StageError(
            f"its matte is empty at {camera.width}x{camera.height}: it contains only specks"
        )
    alpha = repaired_matte(alpha)
    return DepthView(camera, rgb, alpha, silhouette_distance(alpha))


def repaired_matte(alpha: np.ndarray) -> np.ndarray:
    """Remove specks from a matte (H, W) and fill small holes, which would pierce the whole hull."""

    def parts(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
        return stats[1:, cv2.CC_STAT_AREA], labels

    mask = (alpha > INSIDE).astype(np.uint8)
    areas, labels = parts(mask)
    specks = np.flatnonzero(areas < SPECK * areas.max()) + 1
    kept = np.where(np.isin(labels, specks), 0.0, alpha).astype(np.float32)
    gaps, labels = parts((kept <= INSIDE).astype(np.uint8))
    border = np.unique(np.r_[labels[[0, -1]].ravel(), labels[:, [0, -1]].ravel()])
    holes = np.setdiff1d(np.flatnonzero(gaps < HOLE * mask.sum()) + 1, border)
    return np.where(np.isin(labels, holes), np.float32(1), kept)


def with_face(view: DepthView, head: TrackedHead) -> DepthView:
    """Add to a view's matte the parts of a tracked face that it lacks.

    A wall with the colour of skin takes them out of a matte, and each would pierce the whole hull.
    A part counts if it reaches further inside the mesh's outline than tracks are usually off.
    """
    mesh, depth = render_head(head, view.camera)
    lacking = label_mask(mesh, *FACE) & (view.alpha <= INSIDE)
    inside = _mask_distance(mesh > 0) * depth / view.camera.K[0, 0]
    _, part = cv2.connectedComponents(lacking.astype(np.uint8), connectivity=8)
    lost = lacking & np.isin(part, part[lacking & (inside > LOST_M)])
    if not lost.any():
        return view
    alpha = np.where(lost, np.float32(1), view.alpha)
    return replace(view, alpha=alpha, silhouette_px=silhouette_distance(alpha))


def silhouette_distance(alpha: np.ndarray) -> np.ndarray:
    """Measure the signed distance (H, W) float32, pixels, positive inside, to alpha's 0.5 contour.

    Near the contour, the matte is enlarged first, so that it keeps the matte's subpixel position.
    Pixels beyond the image are unknown, not empty: a head cut by the border stays inside there.
    """
    signed = _mask_distance(alpha > INSIDE)
    box = box_about(alpha > INSIDE, ENLARGED_PX)
    part = alpha[box].astype(np.float32)
    large = cv2.resize(part, None, fx=UPSAMPLE, fy=UPSAMPLE, interpolation=cv2.INTER_LINEAR)
    fine = _mask_distance(large > INSIDE) / UPSAMPLE
    signed[box] = cv2.resize(fine, part.shape[::-1], interpolation=cv2.INTER_AREA)
    limit = float(sum(alpha.shape))  # a matte without a contour is infinitely far from one
    return np.clip(signed, -limit, limit)


def _mask_distance(mask: np.ndarray) -> np.ndarray:
    """Measure the signed distance (H, W) of each pixel to a mask's edge, positive inside."""
    outside, inside = (
        cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
        for part in (~mask, mask)
    )
    # Distances are to pixel centres across the edge: half a pixel too long on either side.
    return np.where(mask, inside - np.float32(0.5), np.float32(0.5) - outside)


def project_fast(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project points (N, 3) into a pinhole camera: pixels (N, 2), depths (N,); float32, no NaN."""
    # Relative to the camera before the cast: a rig may be a kilometre from its world's origin.
    about = (points - camera.center).astype(np.float32)
    x, y, depth = (camera.K @ camera.cam_from_world[:3, :3]).astype(np.float32) @ about.T
    divisor = np.maximum(depth, np.float32(1e-6))
    return np.stack([x / divisor, y / divisor]).T, depth  # columns follow each other in memory


def in_picture(
    camera: Camera, pixels: np.ndarray, depth: np.ndarray, inset: float = 0.0
) -> np.ndarray:
    """Mark the points (N,) in front of a camera whose pixels (N, 2) lie within its picture.

    `inset` pixels along the border do not count. One column after the other takes a tenth of the
    time of `all(1)`.
    """
    x, y = pixels.T
    across = (x >= inset) & (x <= camera.width - inset)
    return across & (y >= inset) & (y <= camera.height - inset) & (depth > 0)


def pixel_size(view: DepthView, point: np.ndarray) -> float:
    """Measure the metres that a pixel spans at a world point (3,)."""
    M = view.camera.cam_from_world
    return float(abs(M[2, :3] @ point + M[2, 3]) / view.camera.K[0, 0])


def hull_distance(views: Sequence[DepthView], points: np.ndarray) -> np.ndarray:
    """Measure signed distances (N,) of points (N, 3) to the visual hull, metres, negative inside.

    It is the maximum over the views (Laurentini 1994). Points that fewer than two views, or less
    than a third of them, see are outside; otherwise phantoms would float in front of the head.
    """
    distance = np.full(len(points), -UNSEEN, np.float32)
    seen = np.zeros(len(points), np.int16)
    for view in views:
        camera = view.camera
        pixels, depth = project_fast(camera, points)
        inside = in_picture(camera, pixels, depth)
        metres = -bilinear(view.silhouette_px, pixels[inside]) * depth[inside] / camera.focal
        distance[inside] = np.maximum(distance[inside], metres)
        seen += inside
    return np.where(seen >= max(2, len(views) / 3), distance, UNSEEN).astype(np.float32)


def head_box(views: Sequence[DepthView]) -> tuple[np.ndarray, np.ndarray]:
    """Find the corners (3,), (3,) of the box around the visual hull, metres.

    Raises:
        StageError: the silhouettes have no common volume, or a camera's pose is not rigid.
    """
    for view in views:
        if not is_rigid(view.camera.cam_from_world):
            raise StageError(
                f"camera {view.camera.id}: its pose is not a rotation and a translation; expected"
                " finite numbers and det 1: check the calibration"
            )
    center, reach = _meeting_point(views), []
    for view in views:
        pixel, depth = project(view.camera, center[None])
        y, x = np.nonzero(view.alpha > INSIDE)
        offset = cell_to_corner(np.stack([x, y], axis=1)) - pixel[0]
        if depth[0] <= 0 or not np.isfinite(offset).all():
            raise StageError(
                f"camera {view.camera.id}: the head lies behind it; expected every camera to face"
                " the head: check the calibration"
            )
        furthest = np.linalg.norm(offset, axis=1).max()
        reach.append(float(1.1 * furthest * depth[0] / view.camera.K[0, 0]))
    radius = np.full(3, max(reach))
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
    if len(views) < 2:
        raise StageError(f"a surface needs two cameras with a matte, got {len(views)}")
    centers, directions = [view.camera.center for view in views], []
    for view in views:
        y, x = np.nonzero(view.alpha > INSIDE)
        K, R = view.camera.K, view.camera.cam_from_world[:3, :3]
        middle = cell_to_corner(np.array([x.mean(), y.mean()]))
        ray = np.r_[(middle - K[:2, 2]) / K[[0, 1], [0, 1]], 1.0]
        directions.append(R.T @ ray / np.linalg.norm(ray))
    point = nearest_to_lines(centers, directions, 1e-4)
    if point is None or np.linalg.norm(np.std(centers, axis=0)) < 1e-6:
        raise StageError(
            f"{len(views)} cameras look along one line; expected two directions at least a degree"
            " apart: check the calibration"
        )
    return point


def without_contradiction(views: Sequence[DepthView]) -> tuple[list[DepthView], list[Note]]:
    """Leave out the one view, if any, without which the common hull fills the mattes again."""
    if len(views) < VOTERS:
        return list(views), []
    boxes = []  # of every second view each: one bad view spoils only one of them
    for half in (views[0::2], views[1::2]):
        with contextlib.suppress(StageError):
            boxes.append(head_box(half))
    boxes = boxes or [head_box(views)]
    low, high = max(boxes, key=lambda box: float(np.prod(box[1] - box[0])))
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


class _Vote(NamedTuple):
    """One view's evidence about P cells of space."""

    allows: np.ndarray  # (P,) which ones its matte allows
    pixel: np.ndarray  # (P,) flat index of the matte, about one pixel per cell; -1 where unseen
    matte: np.ndarray  # (h, w)


def _vote(view: DepthView, points: np.ndarray, cell: float) -> _Vote:
    """Let a view judge cells of ``cell`` metres around points (P, 3)."""
    pixels, depth = project_fast(view.camera, points)
    size = np.array([view.camera.width, view.camera.height])
    seen = in_picture(view.camera, pixels, depth)
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
