"""Which cameras of an item can be used, and why the others cannot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from express50.errors import StageError
from express50.files.images import resize_area
from express50.geometry.cameras import Camera, resized
from pipelines.depth.grid import (
    INSIDE,
    View,
    head_box,
    project_fast,
    sample_image,
    silhouette_distance,
)

EMPTY = 0.002  # share of the image below which a matte holds no head
FULL = 0.98  # share above which a matte cuts nothing out
VOTERS = 5  # fewest views of which one can be outvoted
MISSED = 0.001  # share of the mattes that the hull may miss before anyone is suspected
OUTVOTED = 2.0  # times less must be missed without the view left out than without any other
CELLS = 64  # along the sides of the box in which views are compared
HOLE = 0.05  # share of the matte up to which a hole in it is filled


def make_view(camera: Camera, rgb: np.ndarray, alpha: np.ndarray, side: int) -> View | str:
    """A view of images at most ``side`` pixels large, or the reason why it cannot be used.

    Args:
        camera: undistorted pinhole camera.
        rgb: (H, W, 3) uint8 sRGB.
        alpha: (H, W) float32 in [0, 1]; the view's is without specks and small holes.
        side: longest side, pixels; larger images are averaged down.
    """
    if rgb.shape[:2] != (camera.height, camera.width) or alpha.shape != rgb.shape[:2]:
        return (
            f"frame {rgb.shape[1]}x{rgb.shape[0]} and matte {alpha.shape[1]}x{alpha.shape[0]} are"
            f" not the camera's {camera.width}x{camera.height}"
        )
    share = float((alpha > INSIDE).mean())
    if share < EMPTY:
        return f"its matte is empty ({share:.2%} of the image)"
    if share > FULL:
        return f"its matte covers {share:.1%} of the image and cuts nothing out"
    scale = side / max(camera.width, camera.height)
    if scale < 1:
        width, height = round(camera.width * scale), round(camera.height * scale)
        camera = resized(camera, width, height)
        rgb, alpha = resize_area(rgb, width, height), resize_area(alpha, width, height)
    if not (alpha > INSIDE).any():
        return f"its matte is empty at {camera.width}x{camera.height}: specks are all it holds"
    alpha = _mended(alpha)
    return View(camera, rgb, alpha, silhouette_distance(alpha))


def _mended(alpha: np.ndarray) -> np.ndarray:
    """The matte (H, W) without islands under a hundredth of its largest part, small holes filled.

    A hole drills a tunnel through the whole hull. Where one is real, between strands, filling it
    costs nothing: its pixels stay outside the matte that depth is valid in.
    """
    mask = (alpha > INSIDE).astype(np.uint8)
    areas, labels = _parts(mask)
    small = np.flatnonzero(areas < 0.01 * areas.max()) + 1
    kept = np.where(np.isin(labels, small), 0.0, alpha).astype(np.float32)
    gaps, labels = _parts((kept <= INSIDE).astype(np.uint8))
    border = np.unique(np.r_[labels[[0, -1]].ravel(), labels[:, [0, -1]].ravel()])
    holes = np.setdiff1d(np.flatnonzero(gaps < HOLE * mask.sum()) + 1, border)
    return np.where(np.isin(labels, holes), np.float32(1), kept)


def _parts(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Areas (N,) of the connected parts of a mask (H, W), and labels (H, W) from 1."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    return stats[1:, cv2.CC_STAT_AREA], labels


def without_contradiction(views: Sequence[View]) -> tuple[list[View], dict[str, str]]:
    """Views whose mattes agree, and why others were left out: {camera: reason}.

    A matte that misses half of the head, or a camera that is not where it is said to be, carves the
    common hull away: the hull then no longer fills the mattes, but does without that view.
    """
    if len(views) < VOTERS:
        return list(views), {}
    silhouettes = _silhouettes(views)
    everyone = np.ones(len(views), bool)
    missed = _unfilled(silhouettes, everyone)
    if missed < MISSED:
        return list(views), {}
    without = [_unfilled(silhouettes, np.arange(len(views)) != k) for k in range(len(views))]
    worst = int(np.argmin(without))
    second = float(np.sort(without)[1])
    if without[worst] > second / OUTVOTED or second < MISSED / 2:
        return list(views), {}
    why = (
        f"it contradicts the others (the common hull misses {missed:.1%} of the mattes with it,"
        f" {without[worst]:.1%} without it): check its matte and its calibration"
    )
    return [v for k, v in enumerate(views) if k != worst], {views[worst].camera.id: why}


@dataclass(frozen=True)
class _Silhouette:
    """A view's say on cells of space.

    Attributes:
        allows: (P,) whether the view does not rule the cell out; it lies in the matte or unseen.
        pixel: (P,) flat pixel of the cell in ``matte``, -1 where unseen.
        matte: (h, w) bool, about a pixel a cell.
    """

    allows: np.ndarray
    pixel: np.ndarray
    matte: np.ndarray


def _silhouettes(views: Sequence[View]) -> list[_Silhouette]:
    """What every view says of the cells of a box around the head."""
    low, high = head_box_without_each(views)
    axes = [np.linspace(a, b, CELLS) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    cell = float((high - low).max() / (CELLS - 1))
    return [_silhouette(view, points, cell) for view in views]


def _silhouette(view: View, points: np.ndarray, cell: float) -> _Silhouette:
    pixels, depth = project_fast(view.camera, points)
    size = np.array([view.camera.width, view.camera.height])
    seen = (depth > 0) & (pixels >= 0).all(1) & (pixels < size).all(1)
    near = float(np.median(depth[seen])) if seen.any() else 1.0
    step = max(1.0, cell * view.camera.K[0, 0] / near)
    shape = np.maximum(1, np.ceil(size / step)).astype(int)
    allows = np.ones(len(points), bool)
    allows[seen] = sample_image(view.silhouette_px, pixels[seen]) > -step / 2
    column, row = np.minimum((pixels[seen] / step).astype(int), shape - 1).T
    pixel = np.full(len(points), -1)
    pixel[seen] = row * shape[0] + column
    small = resize_area(view.silhouette_px, int(shape[0]), int(shape[1]))
    return _Silhouette(allows, pixel, small > 0)


def _unfilled(silhouettes: Sequence[_Silhouette], used: np.ndarray) -> float:
    """Share of the mattes, mean over the views ``used`` (C,), that their hull does not fill."""
    chosen = [one for one, use in zip(silhouettes, used, strict=True) if use]
    hull = np.stack([one.allows for one in chosen]).all(0)
    shares = []
    for one in chosen:
        filled = np.zeros(one.matte.size, np.uint8)
        filled[one.pixel[hull & (one.pixel >= 0)]] = 1
        filled = cv2.dilate(filled.reshape(one.matte.shape), np.ones((3, 3), np.uint8))
        shares.append(float((filled[one.matte] == 0).mean()) if one.matte.any() else 0.0)
    return float(np.mean(shares))


def head_box_without_each(views: Sequence[View]) -> tuple[np.ndarray, np.ndarray]:
    """Box (3,), (3,) that holds the hull of the views less any one of them, metres.

    Two halves of the rig, every second view each, span it: one bad view spoils one of them only.
    """
    boxes = [_box_or_none(views[0::2]), _box_or_none(views[1::2])]
    found = [box for box in boxes if box is not None] or [head_box(views)]
    largest = max(found, key=lambda box: float(np.prod(box[1] - box[0])))
    return largest


def _box_or_none(views: Sequence[View]) -> tuple[np.ndarray, np.ndarray] | None:
    try:
        return head_box(views)
    except StageError:
        return None
