"""Views of a head: silhouettes turned into signed distances, the box around their hull."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from express50.errors import StageError
from express50.geometry.cameras import Camera, project
from express50.geometry.conventions import cell_to_corner, corner_to_cell

INSIDE = 0.5  # alpha at a silhouette
UNSEEN = 1.0  # metres; the distance given to space that too few cameras see


@dataclass(frozen=True)
class View:
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


def silhouette_distance(alpha: np.ndarray, upsample: int = 3) -> np.ndarray:
    """Signed distance (H, W) float32, pixels, positive inside, to the half-opaque contour.

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


def sample_image(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Bilinear values of an image (H, W) at corner-origin pixels (N, 2); border values outside."""
    count = len(pixels)
    columns = 4096  # cv2.remap takes at most 32767 rows and columns
    padded = np.zeros((-(-count // columns) * columns, 2), np.float32)
    padded[:count] = corner_to_cell(pixels)
    maps = padded.reshape(-1, columns, 2)
    out = np.empty(maps.shape[:2], np.float32)
    for start in range(0, len(maps), 8192):
        block = np.ascontiguousarray(maps[start : start + 8192])
        out[start : start + 8192] = cv2.remap(
            image, block[..., 0], block[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    return out.reshape(-1)[:count]


def project_fast(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) and depths (N,) float32 of points (N, 3) in a pinhole camera; no NaN."""
    # Against the camera before the cast: a rig may stand a kilometre from its world's origin.
    about = (points - camera.center).astype(np.float32)
    p = about @ (camera.K @ camera.cam_from_world[:3, :3]).T.astype(np.float32)
    depth = np.maximum(p[:, 2], 1e-6)
    return p[:, :2] / depth[:, None], p[:, 2]


def hull_distance(views: Sequence[View], points: np.ndarray) -> np.ndarray:
    """Signed distance (N,) of points (N, 3) to the visual hull, metres, negative inside.

    Each view bounds the distance by its silhouette's, scaled from pixels to metres at the point's
    depth; the hull is the intersection, hence the maximum (Laurentini 1994). Points that fewer
    than two views, or a third of them, see are outside: phantoms would float before the head.
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
        metres = -sample_image(view.silhouette_px, pixels[inside]) * depth[inside] / focal
        distance[inside] = np.maximum(distance[inside], metres)
        seen += inside
    return np.where(seen >= max(2, len(views) / 3), distance, UNSEEN).astype(np.float32)


def head_box(views: Sequence[View], cells: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,), (3,) of the box around the visual hull, metres.

    Raises:
        StageError: the silhouettes have no common volume.
    """
    center, radius = _meeting_point(views)
    for _ in range(2):
        axis = np.linspace(-1.0, 1.0, cells)
        corner = center - radius
        cube = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
        points = center + radius * cube
        step = 2.0 * radius / (cells - 1)
        inside = points[hull_distance(views, points) < 0.5 * step.max()]
        if not len(inside):
            raise StageError(
                f"the silhouettes of {len(views)} cameras share no volume around {center.round(3)};"
                " expected mattes of one head in one world: check mattes and calibration"
            )
        low, high = inside.min(0) - step, inside.max(0) + step
        corner, radius = low, (high - low) / 2.0
        center = corner + radius
    return center - radius, center + radius


def _meeting_point(views: Sequence[View]) -> tuple[np.ndarray, np.ndarray]:
    """Where the rays through the mattes' centres meet (3,), and half the size of the cube there."""
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
    center = np.linalg.solve(A, b)
    return center, np.full(3, max(_extent(view, center) for view in views))


def _extent(view: View, center: np.ndarray) -> float:
    """Largest distance, metres, of the matte's outline from ``center`` (3,) at its depth."""
    pixels, depth = project(view.camera, center[None])
    y, x = np.nonzero(view.alpha > INSIDE)
    offset = cell_to_corner(np.stack([x, y], axis=1)) - pixels[0]
    if depth[0] <= 0 or not np.isfinite(offset).all():
        raise StageError(
            f"camera {view.camera.id}: the head lies behind it; expected every camera to face the"
            " head: check the calibration"
        )
    return float(1.1 * np.linalg.norm(offset, axis=1).max() * depth[0] / view.camera.K[0, 0])
