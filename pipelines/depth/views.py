"""Which cameras of an item can be used, and why the others cannot."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from express50.cameras import Camera, resized
from express50.errors import StageError
from express50.images import resize_area
from pipelines.depth.grid import INSIDE, View, head_box, hull_distance, silhouette_distance

EMPTY = 0.002  # share of the image below which a matte holds no head
FULL = 0.98  # share above which a matte cuts nothing out
CONTRADICTION = 1.8  # growth of the hull without a view that marks its matte as wrong
VOTERS = 5  # fewest views of which one can be outvoted


def make_view(camera: Camera, rgb: np.ndarray, alpha: np.ndarray, side: int) -> View | str:
    """A view of images at most ``side`` pixels large, or the reason why it cannot be used.

    Args:
        camera: undistorted pinhole camera.
        rgb: (H, W, 3) uint8 sRGB.
        alpha: (H, W) float32 in [0, 1].
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
    alpha = np.ascontiguousarray(alpha, np.float32)
    return View(camera, rgb, alpha, silhouette_distance(_without_specks(alpha)))


def _without_specks(alpha: np.ndarray) -> np.ndarray:
    """The matte (H, W) without islands under a hundredth of its largest part."""
    mask = (alpha > INSIDE).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    small = np.flatnonzero(areas < 0.01 * areas.max()) + 1
    return np.where(np.isin(labels, small), 0.0, alpha) if len(small) and count > 2 else alpha


def without_contradiction(views: Sequence[View]) -> tuple[list[View], dict[str, str]]:
    """Views whose mattes agree, and why others were left out: {camera: reason}.

    A matte that misses the head or half of it carves the hull away; the hull then grows several
    times over without that view, but hardly without any other.
    """
    if len(views) < VOTERS:
        return list(views), {}
    low, high = head_box_without_each(views)
    axes = [np.linspace(a, b, 48) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    alone = np.stack([hull_distance([view, view], points) < 0 for view in views])
    votes = alone.sum(0)
    everyone = max(int((votes == len(views)).sum()), 1)
    growth = [1 + int(((votes == len(views) - 1) & ~row).sum()) / everyone for row in alone]
    worst = int(np.argmax(growth))
    second = float(np.sort(growth)[-2])
    if growth[worst] < CONTRADICTION * second:
        return list(views), {}
    why = (
        f"its matte contradicts the others (the common hull is {growth[worst]:.1f} times larger"
        " without it)"
    )
    return [v for k, v in enumerate(views) if k != worst], {views[worst].camera.id: why}


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
