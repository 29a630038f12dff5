"""Cast rays at the surface: depth, normals and confidence per camera, checked by its neighbours.

Confidence comes from photometric reprojection: each view is warped into its neighbours' pictures
through its own depth map. Where the surface is right the colours agree up to gain, highlights and
noise. On bare skin a small error proves little, a large one always shows (Seitz et al. 2006).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import open3d as o3d

from express50.geometry.cameras import Camera, rays
from express50.geometry.raycast import barycentrics, camera_rays, mesh_scene
from express50.geometry.sampling import bilinear
from pipelines.depth.surface import HeadSurface
from pipelines.depth.views import INSIDE, project_fast, reduced

STEEP = 0.25  # cosine between surface and ray below which confidence fades to 0
BROKEN = 4.0  # pixels' widths between neighbours' depths at which confidence is halved
COMPARED_SIDE = 512  # longest side, pixels, at which views are compared through the depth
NEIGHBOURS = 4  # views that each is compared with, those whose directions are closest
CONSISTENT_STEPS = 10.0  # 8-bit steps up to which colours agree: noise and highlights take some
DARK = 16.0  # 8-bit steps; darker pixels say nothing about gain
FLAT = 4.0  # tangent of the angle between line of sight and normal from which colours smear
HIDDEN_M = 0.004  # metres behind the neighbour's own depth at which a point counts as hidden
DOUBT_STEPS = 5.0  # 8-bit steps of error by which confidence falls to 1/e
UNSEEN_TRUST = 0.2  # what is left of confidence where no neighbour sees the point
WINDOW = 5  # pixels, odd: colours around a wrong depth agree here and there by chance

Pictures = list[tuple[Camera, np.ndarray, np.ndarray]]
"""Cameras with their full-size frames (H, W, 3) uint8 and mattes (H, W) float32."""


@dataclass(frozen=True)
class DepthMaps:
    """The maps (H, W) of the surface in one camera, `valid` where it lies inside the matte.

    Depth is in metres, normals (H, W, 3) in camera axes, both 0 where not valid; confidence is in
    [0, 1]. `covered` is the share of the matte with depth, `spill` that of the surface outside.
    """

    depth: np.ndarray
    valid: np.ndarray
    confidence: np.ndarray
    normals: np.ndarray
    covered: float
    spill: float


@dataclass(frozen=True)
class ComparedView:
    """One camera's colours (H, W, 3) float32, 8-bit steps, at the size of the comparison.

    `depth` (H, W) is in metres, 0 where there is none; `plain` (H, W) pixels lie off every edge and
    see the surface at no flat angle.
    """

    camera: Camera
    colour: np.ndarray
    depth: np.ndarray
    plain: np.ndarray


@dataclass(frozen=True)
class PhotoErrors:
    """Photometric errors (H, W), 8-bit steps, of one view; NaN where no neighbour sees the point.

    ``compared`` is the share that they see.
    """

    errors: np.ndarray
    compared: float

    def figures(self) -> dict[str, float]:
        """Summarise the errors and the shares compared and consistent for the metrics."""
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


def surface_maps(
    surface: HeadSurface, pictures: Pictures
) -> tuple[dict[str, DepthMaps], dict[str, PhotoErrors]]:
    """Make every camera's maps of the surface and its neighbours' errors, by camera."""
    scene = mesh_scene(surface.vertices, surface.faces)
    photo = photo_errors([compared_view(scene, *row) for row in pictures])
    maps = {}
    for (camera, _, alpha), errors in zip(pictures, photo, strict=True):
        maps[camera.id] = doubted(cast_maps(surface, scene, camera, alpha), errors)
    return maps, dict(zip(maps, photo, strict=True))


def cast_maps(
    surface: HeadSurface,
    scene: o3d.t.geometry.RaycastingScene,
    camera: Camera,
    alpha: np.ndarray,
) -> DepthMaps:
    """Cast a camera's rays; depth is valid where they hit inside the matte (H, W)."""
    hits = scene.cast_rays(camera_rays(camera), nthreads=1)
    depth = hits["t_hit"].numpy()
    hit = np.isfinite(depth)
    faces = surface.faces[hits["primitive_ids"].numpy()[hit]]
    corners = barycentrics(hits, hit)
    normals, confidence = np.zeros((*depth.shape, 3)), np.zeros(depth.shape)
    normals[hit] = (surface.normals[faces] * corners[..., None]).sum(1)
    confidence[hit] = (surface.confidence[faces] * corners).sum(1)
    return make_maps(camera, alpha, depth, normals, confidence)


def make_maps(
    camera: Camera,
    alpha: np.ndarray,
    depth: np.ndarray,
    normals: np.ndarray,
    confidence: np.ndarray,
) -> DepthMaps:
    """Keep what is hit inside the matte (H, W); weaken confidence at slants and where depth jumps.

    `depth` (H, W) is not finite where nothing is hit; `normals` (H, W, 3) are the world's.
    """
    hit = np.isfinite(depth) & (depth > 0)
    inside = alpha > INSIDE
    valid = hit & inside
    normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    _, way = rays(camera)
    cosine = -(normals * way).sum(-1) / np.linalg.norm(way, axis=-1)
    depth = np.where(valid, depth, 0).astype(np.float32)
    whole = np.clip(cosine / STEEP, 0, 1) / (1 + jumps(camera, depth) / BROKEN)
    confidence = np.where(valid, confidence * whole, 0.0)
    picture = np.where(valid[..., None], normals @ camera.cam_from_world[:3, :3].T, 0.0)
    return DepthMaps(
        depth=depth,
        valid=valid,
        confidence=np.clip(confidence, 0, 1).astype(np.float32),
        normals=picture.astype(np.float32),
        covered=float(valid.sum() / max(int(inside.sum()), 1)),
        spill=float((hit & ~inside).sum() / max(int(hit.sum()), 1)),
    )


def jumps(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Measure the range (H, W) of depth (H, W; 0: none) over a pixel and its eight neighbours.

    The unit is a pixel's width at that depth; outlines are infinite.
    """
    square = np.ones((3, 3), np.uint8)
    low, high = (way(depth.astype(np.float32), square) for way in (cv2.erode, cv2.dilate))
    return np.where(low > 0, (high - low) * camera.K[0, 0] / np.maximum(high, 1e-12), np.inf)


def compared_view(
    scene: o3d.t.geometry.RaycastingScene,
    camera: Camera,
    rgb: np.ndarray,
    alpha: np.ndarray,
    side: int = COMPARED_SIDE,
) -> ComparedView:
    """Reduce a picture (H, W, 3) uint8 to at most ``side`` pixels, with depth inside its matte."""
    camera, rgb, alpha = reduced(camera, rgb, alpha, side)
    depth = scene.cast_rays(camera_rays(camera), nthreads=1)["t_hit"].numpy()
    seen = np.isfinite(depth) & (alpha > INSIDE)
    depth = np.where(seen, depth, 0).astype(np.float32)
    # At a neighbour's outline colours mix with the background, and a pixel spans centimetres.
    plain = jumps(camera, depth) < 2 * FLAT  # over the two steps from side to side
    return ComparedView(camera, rgb.astype(np.float32), depth, plain)


def photo_errors(views: Sequence[ComparedView]) -> list[PhotoErrors]:
    """Compare each view with its neighbours through its depth: their median colour difference."""
    forward = np.stack([view.camera.cam_from_world[2, :3] for view in views])
    closeness = forward @ forward.T
    np.fill_diagonal(closeness, -2.0)
    order = np.argsort(-closeness, axis=1, kind="stable")[:, : min(NEIGHBOURS, len(views) - 1)]
    found = []
    for i, (view, row) in enumerate(zip(views, order, strict=True)):
        others = [views[k] for k in row if closeness[i, k] > 0]
        errors = np.full(view.depth.shape, np.nan, np.float32)
        seen = view.depth > 0
        if not seen.any() or not others:
            found.append(PhotoErrors(errors, 0.0))
            continue
        origin, directions = rays(view.camera)
        points = origin + view.depth[seen, None] * directions[seen]
        table = np.sort([_difference(view.colour[seen], points, other) for other in others], 0)
        count = np.isfinite(table).sum(0)  # NaN is sorted last
        column = np.arange(len(points))
        low, high = (table[np.maximum(k, 0) // 2, column] for k in (count - 1, count))
        middle = (low + np.where(count > 1, high, low)) / 2
        errors[seen] = np.where(count > 0, middle, np.nan)
        found.append(PhotoErrors(errors, float((count > 0).mean())))
    return found


def _difference(colour: np.ndarray, points: np.ndarray, other: ComparedView) -> np.ndarray:
    """Compare colours (N, 3) with a neighbour's, gains evened: (N,), NaN where hidden."""
    pixels, depth = project_fast(other.camera, points)
    size = np.array([other.camera.width, other.camera.height])
    there = (depth > 0) & ((pixels >= 1) & (pixels <= size - 1)).all(1)
    column, row = np.floor(pixels[there]).astype(int).T
    hidden = depth[there] - other.depth[row, column] > HIDDEN_M
    there[there] = other.plain[row, column] & ~hidden
    found = np.full(len(points), np.nan, np.float32)
    theirs = bilinear(other.colour, pixels[there])
    mine = colour[there]
    bright = (mine > DARK) & (theirs > DARK)
    gain = [
        float(np.median(mine[b, k] / theirs[b, k])) if (b := bright[:, k]).any() else 1.0
        for k in range(3)
    ]
    found[there] = np.abs(mine - theirs * gain).mean(1)
    return found


def doubted(maps: DepthMaps, photo: PhotoErrors) -> DepthMaps:
    """Lower the confidence where neighbours' colours contradict the depth.

    The root of the product keeps the differences of small values in 8 bits.
    """
    known = np.isfinite(photo.errors)
    total, count = (
        cv2.blur(values.astype(np.float32), (WINDOW, WINDOW))
        for values in (np.where(known, photo.errors, 0.0), known)
    )
    compared = count > 0.5 / WINDOW**2
    believed = np.exp(-total / np.maximum(count, 1e-6) / DOUBT_STEPS)
    believed = np.where(compared, believed, UNSEEN_TRUST).astype(np.float32)
    height, width = maps.confidence.shape
    believed = cv2.resize(believed, (width, height), interpolation=cv2.INTER_LINEAR)
    return replace(maps, confidence=np.sqrt(maps.confidence * believed))
