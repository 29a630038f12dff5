"""What every camera sees of the surface: depth, confidence, normals."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d

from express50.geometry.cameras import Camera, rays
from express50.geometry.raycast import camera_rays
from pipelines.depth.finish import Surface
from pipelines.depth.grid import INSIDE

STEEP = 0.25  # cosine between surface and ray below which confidence fades to 0
BROKEN = 4.0  # pixels' widths between neighbours' depths at which confidence is halved


@dataclass(frozen=True)
class DepthView:
    """Depth (H, W) metres (0 where not valid), valid (H, W), confidence (H, W), normals (H, W, 3).

    Normals are in camera axes, 0 where not valid; ``covered`` is the share of the matte that the
    surface fills, ``spill`` the surface's share outside the matte.
    """

    depth: np.ndarray
    valid: np.ndarray
    confidence: np.ndarray
    normals: np.ndarray
    covered: float
    spill: float


def cast_view(
    surface: Surface, scene: o3d.t.geometry.RaycastingScene, camera: Camera, alpha: np.ndarray
) -> DepthView:
    """Raycast one camera; depth is valid where the surface is hit inside the matte (H, W)."""
    hits = scene.cast_rays(camera_rays(camera), nthreads=1)
    depth = hits["t_hit"].numpy()
    hit = np.isfinite(depth)
    faces = surface.faces[hits["primitive_ids"].numpy()[hit]]
    u, v = hits["primitive_uvs"].numpy()[hit].T
    corners = np.stack([1 - u - v, u, v], axis=1)  # (n, 3) barycentric
    normals, confidence = np.zeros((*depth.shape, 3)), np.zeros(depth.shape)
    normals[hit] = (surface.normals[faces] * corners[..., None]).sum(1)
    confidence[hit] = (surface.confidence[faces] * corners).sum(1)
    return depth_view(camera, alpha, depth, normals, confidence)


def depth_view(
    camera: Camera,
    alpha: np.ndarray,
    depth: np.ndarray,
    normals: np.ndarray,
    confidence: np.ndarray,
) -> DepthView:
    """A camera's picture of a surface: valid where it is hit inside the matte (H, W).

    `depth` (H, W) is not finite where nothing is hit; `normals` (H, W, 3) are of the world and of
    any length; `confidence` (H, W) fades where the surface is seen at a slant, and where depth
    jumps: a pixel there is of neither side.
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
    return DepthView(
        depth=depth,
        valid=valid,
        confidence=np.clip(confidence, 0, 1).astype(np.float32),
        normals=picture.astype(np.float32),
        covered=float(valid.sum() / max(int(inside.sum()), 1)),
        spill=float((hit & ~inside).sum() / max(int(hit.sum()), 1)),
    )


def jumps(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Range (H, W) of depth (H, W; 0: none) over a pixel and its eight neighbours.

    In widths of a pixel at that depth, whatever unit and focal length; infinite at an outline.
    """
    square = np.ones((3, 3), np.uint8)
    low, high = (way(depth.astype(np.float32), square) for way in (cv2.erode, cv2.dilate))
    return np.where(low > 0, (high - low) * camera.K[0, 0] / np.maximum(high, 1e-12), np.inf)
