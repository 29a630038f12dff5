"""Undistort and sample images and measure their blur; choose items evenly; steps and harmonics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

import cv2
import numpy as np

from express50.geometry.cameras import Camera, crop_camera, in_field, resized
from express50.geometry.conventions import K_to_opencv, cell_centres, corner_to_cell

T = TypeVar("T")

# cv2.remap takes at most 32767 rows and columns; this many points per call fit in the cache.
_COLUMNS, _ROWS = 4096, 2048
MAPPED = 480  # places at least along the longer side where a lens is evaluated
SLACK = 0.005  # pixels; `undistort_maps` may be so far off
COARSE = 64  # points across an image that are tested for a fold of the lens
OUTSIDE = -10.0  # pixels; too far outside for an interpolation to reach the image

REACH = 8  # pixels on either side of an edge within which its two levels are looked for
SMOOTH = 0.8  # deviation, pixels, of the filter against noise; subtracted from the width again
LEAST_HEIGHT = 30.0  # grey levels between the sides of an edge, so that noise is not an edge
FEWEST_EDGES = 12
SHARPEST = 20  # percentile of the widths: lashes and hair are sharp, a face is not


def undistort_maps(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return maps (H, W) of x and y, float32, for ``cv2.remap`` from a camera to its pinhole.

    Where the lens folds, the map points outside the image. In large images it is computed once per
    block of pixels and interpolated: at most 0.004 px off for a lens of 80 degrees.
    """
    step = max(1, max(camera.width, camera.height) // MAPPED)
    columns, rows = (-(-side // step) + 2 for side in (camera.width, camera.height))
    size = step * columns, step * rows  # a block more on each side
    blocks = resized(crop_camera(camera, -step, -step, *size), columns, rows)
    K, of_blocks = K_to_opencv(camera.K), K_to_opencv(blocks.K)
    maps = cv2.initUndistortRectifyMap(
        K, camera.dist, None, of_blocks, (columns, rows), cv2.CV_32FC1
    )
    window = np.s_[step : step + camera.height, step : step + camera.width]
    x, y = (cv2.resize(values, size, interpolation=cv2.INTER_LINEAR)[window] for values in maps)
    if pictured_share(camera) < 1:
        across, down = cell_centres(camera.width), cell_centres(camera.height)
        x[~_pictured(camera, across, down)] = OUTSIDE
    return x, y


def pictured_share(camera: Camera) -> float:
    """Return the share of the pinhole camera's pixels that the lens pictures, from a coarse grid.

    It is below 1 if the distortion folds within the image. Its coefficients then belong to another
    image size, or were fitted only to points near the centre.
    """
    across = np.linspace(0, camera.width, COARSE)
    return float(_pictured(camera, across, np.linspace(0, camera.height, COARSE)).mean())


def _pictured(camera: Camera, across: np.ndarray, down: np.ndarray) -> np.ndarray:
    x, y = np.meshgrid(across, down)
    xy = np.stack([x.ravel(), y.ravel()], axis=1) - camera.K[:2, 2]
    return in_field(camera, xy / camera.K[[0, 1], [0, 1]]).reshape(x.shape)


def undistort_image(image: np.ndarray, camera: Camera) -> np.ndarray:
    """Return image (H, W[, C]) as the pinhole camera ``pinhole(camera)`` would see it; 0 outside.

    Raises:
        ValueError: the image's size is not the camera's.
    """
    if image.shape[:2] != (camera.height, camera.width):
        raise ValueError(
            f"camera {camera.id}: image is {image.shape[1]}x{image.shape[0]},"
            f" expected {camera.width}x{camera.height}"
        )
    if not camera.dist.any():
        return image
    x, y = undistort_maps(camera)
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def undistorted_mask(camera: Camera) -> np.ndarray:
    """Return a mask (H, W) of the pinhole camera's pixels that the distorted image covers."""
    x, y = undistort_maps(camera)
    inside = (x > -SLACK) & (x < camera.width - 1 + SLACK)
    return inside & (y > -SLACK) & (y < camera.height - 1 + SLACK)


def bilinear(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Interpolate an image (H, W[, C]) at points (N, 2) quickly: (N[, C]) of the image's type.

    The image is uint8, uint16, float32 or float64 with at most 4 channels; points are x, y with the
    corner of the first pixel as origin. Outside the image its edge pixels repeat. OpenCV rounds
    positions to 1/32 pixel; use `bilinear_slope` if that matters.
    """
    count = len(points)
    columns = min(_COLUMNS, max(count, 1))
    padded = np.zeros((-(-count // columns), columns, 2), np.float32)
    padded.reshape(-1, 2)[:count] = corner_to_cell(points)
    out = np.empty((*padded.shape[:2], *image.shape[2:]), image.dtype)
    for start in range(0, len(padded), _ROWS):
        part = padded[start : start + _ROWS]
        x, y = np.ascontiguousarray(part[..., 0]), np.ascontiguousarray(part[..., 1])
        found = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        out[start : start + _ROWS] = found.reshape(*x.shape, *image.shape[2:])
    return out.reshape(-1, *image.shape[2:])[:count]


def bilinear_slope(image: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate an image (H, W, C) at points (N, 2) exactly: values (N, C), slopes (N, C, 2).

    Both are float64; slopes are per pixel. Outside the image its edge pixels repeat; the slope is
    that of the nearest cell.
    """
    height, width, channels = image.shape
    x, y = np.clip(corner_to_cell(points), 0.0, [width - 1.001, height - 1.001]).T
    column, row = x.astype(np.int64), y.astype(np.int64)
    fx, fy = (x - column)[:, None], (y - row)[:, None]
    flat = image.reshape(-1, channels)
    at = row * width + column
    a, b = flat[at].astype(np.float64), flat[at + 1].astype(np.float64)
    c, d = flat[at + width].astype(np.float64), flat[at + width + 1].astype(np.float64)
    top, low = a + (b - a) * fx, c + (d - c) * fx
    slope = np.stack([(b - a) * (1 - fy) + (d - c) * fy, low - top], axis=2)
    return top + (low - top) * fy, slope


def local_moments(image: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance (H, W) of an image (H, W) in a window about each pixel."""
    mean, square = (cv2.blur(values, (side, side)) for values in (image, image * image))
    return mean, np.maximum(square - mean * mean, 0)


def robust_moments(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return median and deviation (...) of values (N, ...); few outliers change neither much.

    The deviation is the median distance from the median, scaled to that of normal errors.
    """
    middle = np.median(values, axis=0)
    return middle, 1.4826 * np.median(np.abs(values - middle), axis=0)


def edge_width(image: np.ndarray) -> float | None:
    """Measure the width of the sharpest edges of an image (H, W, 3) uint8; None with too few.

    The width is the standard deviation, pixels, of the Gaussian that would blur a step as much: a
    step of height h, blurred by s, rises by at most h / (s sqrt(2 pi)) per pixel.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    grey = cv2.GaussianBlur(grey, (0, 0), SMOOTH)
    slopes = [cv2.Sobel(grey, cv2.CV_32F, x, 1 - x, ksize=1, scale=0.5) for x in (1, 0)]
    slope = cv2.magnitude(*slopes)
    window = np.ones((2 * REACH + 1, 2 * REACH + 1), np.uint8)
    height = cv2.dilate(grey, window) - cv2.erode(grey, window)
    steepest = slope == cv2.dilate(slope, np.ones((REACH + 1, REACH + 1), np.uint8))
    edges = steepest & (height > LEAST_HEIGHT) & (slope > 0)
    if edges.sum() < FEWEST_EDGES:
        return None
    widths = height[edges] / (slope[edges] * math.sqrt(2 * math.pi))
    width = float(np.percentile(widths, SHARPEST))
    return math.sqrt(max(width**2 - SMOOTH**2, 0.0))


def evenly(rows: Sequence[T], count: int) -> list[T]:
    """Return an even choice of at most ``count`` rows, the first and the last among them."""
    places = np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(int)
    return [rows[k] for k in np.unique(places)]


def smoothstep(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """Step smoothly from 0 at ``low`` to 1 at ``high``; ``low`` may exceed ``high``."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def sh_polynomials(directions: np.ndarray) -> np.ndarray:
    """Evaluate the real spherical harmonics (N, 9) at unit directions (N, 3), without constants.

    The order is (0,0), (1,-1), (1,0), (1,1), (2,-2) ... (2,2), without the Condon-Shortley sign:
    1, y, z, x, xy, yz, 3z^2 - 1, xz, x^2 - y^2. Nine coefficients reproduce the irradiance of any
    distant light to about one per cent (Ramamoorthi and Hanrahan 2001, "An efficient representation
    for irradiance environment maps").
    """
    x, y, z = directions.T
    columns = [np.ones_like(x), y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y]
    return np.stack(columns, axis=1)
