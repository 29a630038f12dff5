"""How well the views agree through the depth, where no truth exists: photometric reprojection.

Every view is warped into its neighbours' pictures through its own depth map. Where the surface is
right the colours are those that the neighbour saw, up to its gain, highlights and noise; where it
is off, colours come from beside. Bare skin looks alike a millimetre further: a small error proves
little there, a large one always tells (Seitz et al. 2006 compare surfaces so).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import open3d as o3d

from express50.files.images import resize_area
from express50.geometry.cameras import Camera, rays, resized
from express50.geometry.raycast import camera_rays
from pipelines.depth.grid import INSIDE, project_fast, sample_image
from pipelines.depth.raycast import DepthView, jumps

NEIGHBOURS = 4  # views that each is compared with, those whose directions are closest
CONSISTENT_STEPS = 10.0  # 8-bit steps up to which colours agree: noise and highlights take some
DARK = 16.0  # 8-bit steps; darker pixels tell no gain
FLAT = 4.0  # tangent of the angle between line of sight and normal from which colours smear
HIDDEN_M = 0.004  # metres behind the neighbour's own depth at which a point counts as hidden
DOUBT_STEPS = 5.0  # 8-bit steps of error by which confidence falls to 1/e
UNSEEN_TRUST = 0.2  # what is left of confidence where no neighbour sees the point
WINDOW = 5  # pixels, odd: colours about a wrong depth agree here and there by chance


@dataclass(frozen=True)
class Shot:
    """One camera's picture at the size of the comparison.

    Attributes:
        camera: undistorted pinhole camera.
        colour: (H, W, 3) float32, 8-bit steps.
        depth: (H, W) float32 metres, 0 where there is none.
        plain: (H, W) whether the pixel is off every edge and the surface not seen too flatly there.
    """

    camera: Camera
    colour: np.ndarray
    depth: np.ndarray
    plain: np.ndarray


@dataclass(frozen=True)
class Agreement:
    """Photometric errors (H, W), 8-bit steps, of one view, NaN where no neighbour sees the point.

    ``compared`` is the share of the view's depth that neighbours see.
    """

    errors: np.ndarray
    compared: float

    def numbers(self) -> dict[str, float]:
        """Median and 95th percentile of the errors, and the shares compared and consistent."""
        known = self.errors[np.isfinite(self.errors)]
        if not len(known):
            return {"photo_compared": 0.0}
        median, tail = np.percentile(known, [50, 95])
        return {
            "photo_error_median": float(median),
            "photo_error_p95": float(tail),
            "photo_consistent": float((known <= CONSISTENT_STEPS).mean()),
            "photo_compared": self.compared,
        }


def make_shot(
    scene: o3d.t.geometry.RaycastingScene,
    camera: Camera,
    rgb: np.ndarray,
    alpha: np.ndarray,
    side: int,
) -> Shot:
    """A camera's picture (H, W, 3) uint8 and depth inside its matte (H, W), at most ``side`` px."""
    scale = side / max(camera.width, camera.height)
    if scale < 1:
        camera = resized(camera, round(camera.width * scale), round(camera.height * scale))
        rgb = resize_area(rgb, camera.width, camera.height)
        alpha = resize_area(alpha, camera.width, camera.height)
    depth = scene.cast_rays(camera_rays(camera), nthreads=1)["t_hit"].numpy()
    seen = np.isfinite(depth) & (alpha > INSIDE)
    depth = np.where(seen, depth, 0).astype(np.float32)
    # at a neighbour's outline colours are mixed with what is behind, and a pixel spans centimetres
    plain = jumps(camera, depth) < 2 * FLAT  # over the two steps from side to side
    return Shot(camera, rgb.astype(np.float32), depth, plain)


def agreements(shots: Sequence[Shot]) -> list[Agreement]:
    """What every view's neighbours say of its depth."""
    forward = np.stack([shot.camera.cam_from_world[2, :3] for shot in shots])
    closeness = forward @ forward.T
    np.fill_diagonal(closeness, -2.0)
    order = np.argsort(-closeness, axis=1, kind="stable")[:, : min(NEIGHBOURS, len(shots) - 1)]
    return [
        _agreement(shot, [shots[k] for k in row if closeness[i, k] > 0])
        for i, (shot, row) in enumerate(zip(shots, order, strict=True))
    ]


def vouched(view: DepthView, agreement: Agreement) -> DepthView:
    """The view with the neighbours' colours in its confidence.

    The root of the product of what the surface and what the colours say: small values, which tell
    bad depth from worse, keep their differences in 8 bits.
    """
    known = np.isfinite(agreement.errors)
    total, count = (
        cv2.blur(values.astype(np.float32), (WINDOW, WINDOW))
        for values in (np.where(known, agreement.errors, 0.0), known)
    )
    told = count > 0.5 / WINDOW**2
    believed = np.exp(-total / np.maximum(count, 1e-6) / DOUBT_STEPS)
    believed = np.where(told, believed, UNSEEN_TRUST).astype(np.float32)
    height, width = view.confidence.shape
    believed = cv2.resize(believed, (width, height), interpolation=cv2.INTER_LINEAR)
    return replace(view, confidence=np.sqrt(view.confidence * believed))


def _agreement(shot: Shot, others: Sequence[Shot]) -> Agreement:
    """Median over the neighbours of the colours' difference at every pixel with a depth."""
    errors = np.full(shot.depth.shape, np.nan, np.float32)
    seen = shot.depth > 0
    if not seen.any() or not others:
        return Agreement(errors, 0.0)
    origin, directions = rays(shot.camera)
    points = origin + shot.depth[seen, None] * directions[seen]
    table = np.sort(np.stack([_difference(shot.colour[seen], points, one) for one in others]), 0)
    count = np.isfinite(table).sum(0)  # NaN is sorted last
    column = np.arange(len(points))
    low, high = (table[np.maximum(k, 0) // 2, column] for k in (count - 1, count))
    middle = np.where(count > 0, (low + np.where(count > 1, high, low)) / 2, np.nan)
    errors[seen] = middle
    return Agreement(errors, float((count > 0).mean()))


def _difference(colour: np.ndarray, points: np.ndarray, other: Shot) -> np.ndarray:
    """Mean difference (N,) of colours (N, 3) from a neighbour's, its gain evened; NaN if hidden."""
    pixels, depth = project_fast(other.camera, points)
    size = np.array([other.camera.width, other.camera.height])
    there = (depth > 0) & ((pixels >= 1) & (pixels <= size - 1)).all(1)
    column, row = np.floor(pixels[there]).astype(int).T
    hidden = depth[there] - other.depth[row, column] > HIDDEN_M
    there[there] = other.plain[row, column] & ~hidden
    found = np.full(len(points), np.nan, np.float32)
    if not there.any():
        return found
    planes = [np.ascontiguousarray(other.colour[..., k]) for k in range(3)]
    theirs = np.stack([sample_image(plane, pixels[there]) for plane in planes], axis=1)
    mine = colour[there]
    bright = (mine > DARK) & (theirs > DARK)
    gain = [
        float(np.median(mine[b, k] / theirs[b, k])) if (b := bright[:, k]).any() else 1.0
        for k in range(3)
    ]
    found[there] = np.abs(mine - theirs * gain).mean(1)
    return found
