"""Prepare the cameras of an item: check and repair mattes, measure distances to silhouettes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from express50.errors import StageError
from express50.files.images import resize_area
from express50.geometry.cameras import Camera, resized

INSIDE = 0.5  # alpha at a silhouette
EMPTY = 0.002  # share of the image below which a matte holds no head
FULL = 0.98  # share above which a matte cuts nothing out
SPECK = 0.01  # share of a matte's largest part below which other parts are dropped
HOLE = 0.05  # share of the matte up to which a hole in it is filled


@dataclass(frozen=True)
class DepthView:
    """One usable camera of an item.

    Attributes:
        camera: undistorted pinhole camera.
        rgb: (H, W, 3) uint8 sRGB.
        alpha: (H, W) float32 in [0, 1].
        silhouette_px: (H, W) float32 signed distance to the silhouette, pixels, positive inside.
    """

    camera: Camera
    rgb: np.ndarray
    alpha: np.ndarray
    silhouette_px: np.ndarray


def make_view(camera: Camera, rgb: np.ndarray, alpha: np.ndarray, side: int) -> DepthView:
    """Make a view from images reduced to at most ``side`` pixels.

    Args:
        camera: undistorted pinhole camera.
        rgb: (H, W, 3) uint8 sRGB.
        alpha: (H, W) float32 in [0, 1]; the view's is without specks and small holes.
        side: longest side, pixels; larger images are averaged down.

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
    scale = side / max(camera.width, camera.height)
    if scale < 1:
        width, height = round(camera.width * scale), round(camera.height * scale)
        camera = resized(camera, width, height)
        rgb, alpha = resize_area(rgb, width, height), resize_area(alpha, width, height)
    if not (alpha > INSIDE).any():
        raise StageError(
            f"its matte is empty at {camera.width}x{camera.height}: it holds nothing but specks"
        )
    alpha = repaired_matte(alpha)
    return DepthView(camera, rgb, alpha, silhouette_distance(alpha))


def repaired_matte(alpha: np.ndarray) -> np.ndarray:
    """Remove specks from a matte (H, W) and fill small holes.

    A hole drills a tunnel through the whole hull. Filling a real one, between strands, costs
    nothing: its pixels stay outside the matte in which depth is valid.
    """

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


def silhouette_distance(alpha: np.ndarray, upsample: int = 3) -> np.ndarray:
    """Measure the signed distance (H, W) float32, pixels, positive inside, to alpha's 0.5 contour.

    The matte is enlarged first, so that the contour keeps the matte's subpixel position.
    Pixels beyond the image are unknown, not empty: a head cut by the border stays inside there.
    """
    height, width = alpha.shape
    size = (width * upsample, height * upsample)
    large = cv2.resize(alpha.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    mask = (large > INSIDE).astype(np.uint8)
    inside = cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_5)
    outside = cv2.distanceTransform(1 - mask, cv2.DIST_L2, cv2.DIST_MASK_5)
    # Distances are to pixel centres across the contour: half a pixel too long on either side.
    signed = np.where(mask > 0, inside - 0.5, 0.5 - outside) / upsample
    limit = float(width + height)  # a matte without a contour is infinitely far from one
    signed = np.clip(signed, -limit, limit).astype(np.float32)
    return cv2.resize(signed, (width, height), interpolation=cv2.INTER_AREA)


def project_fast(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project points (N, 3) into a pinhole camera: pixels (N, 2), depths (N,); float32, no NaN."""
    # Relative to the camera before the cast: a rig may be a kilometre from its world's origin.
    about = (points - camera.center).astype(np.float32)
    p = about @ (camera.K @ camera.cam_from_world[:3, :3]).T.astype(np.float32)
    depth = np.maximum(p[:, 2], 1e-6)
    return p[:, :2] / depth[:, None], p[:, 2]


def pixel_size(view: DepthView, point: np.ndarray) -> float:
    """Measure the metres that a pixel spans at a world point (3,)."""
    M = view.camera.cam_from_world
    return float(abs(M[2, :3] @ point + M[2, 3]) / view.camera.K[0, 0])
