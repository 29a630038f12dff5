"""Follow the skin's own texture from the resting face to every other expression.

Both are unwrapped to the face UV map on their current meshes. Where the maps differ, optical flow
(DIS, Kroeger et al. 2016) measures how far the expression's mesh must slide (docs/TRACKING.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from express50.geometry.conventions import cell_to_corner
from express50.geometry.sampling import bilinear
from express50.head.model import HeadModel
from pipelines.track.face_uv import LEAST_SEEN, FaceUvMap, between, unwrap
from pipelines.track.surface import FrameSetCrops, sample_normals
from pipelines.track.terms import SlideTerm

FINE = 2  # texels of 0.65 mm on the cheeks
LIGHT_TEXELS = 6.0  # texels over which light and shade are evened out
NOISE = 0.01  # of root light: contrast must stand out from it
SPACING_TEXELS = 4  # texels between places that are followed
RETURN_TEXELS = 0.6  # texels by which the flow there and back may miss
TEXTURED = 0.02  # least contrast, in every direction, of what is followed
SIGMA = 0.5  # texels
REDUNDANCY = 30.0  # places that count as one, because neighbours err together
RIM = 9  # texels: closer than this to what is not seen, flow is not trusted


@dataclass(frozen=True)
class SkinMap:
    """An expression's skin on the fine UV map: evened grey (H, W) uint8, and where it is seen."""

    grey: np.ndarray
    seen: np.ndarray


def skin_map(
    model: HeadModel, uv_map: FaceUvMap, pictures: FrameSetCrops, mesh: np.ndarray
) -> SkinMap:
    """Unwrap a frame set on its mesh (V, 3), light evened out."""
    colors, mass = unwrap(model, uv_map, pictures, mesh)
    seen = (mass > LEAST_SEEN) & (uv_map.image(uv_map.skin[:, None])[..., 0])
    grey, weight = colors.mean(2), seen.astype(np.float32)

    def local(values: np.ndarray) -> np.ndarray:
        share = cv2.GaussianBlur(weight, (0, 0), LIGHT_TEXELS)
        return cv2.GaussianBlur(values * weight, (0, 0), LIGHT_TEXELS) / np.maximum(share, 1e-3)

    away = (grey - local(grey)) * weight
    even = away / np.sqrt(local(away**2) + NOISE**2)
    return SkinMap(np.clip(128.0 + 42.0 * even, 0, 255).astype(np.uint8), seen)


def skin_flows(
    model: HeadModel,
    uv_map: FaceUvMap,
    pictures: list[FrameSetCrops],
    meshes: np.ndarray,
    rest: int | None,
) -> dict[int, tuple[SlideTerm, ...]]:
    """Follow the skin from the resting face, number `rest`, to the other expressions, by index.

    The pictures are of E frame sets with meshes (E, V, 3).
    """
    if rest is None:
        return {}
    maps = [skin_map(model, uv_map, *pair) for pair in zip(pictures, meshes, strict=True)]
    flows: dict[int, tuple[SlideTerm, ...]] = {}
    for index, (moved, mesh) in enumerate(zip(maps, meshes, strict=True)):
        term = None if index == rest else flow_term(uv_map, maps[rest], moved, mesh)
        flows[index] = () if term is None else (term,)
    return flows


def flow_term(
    uv_map: FaceUvMap, still: SkinMap, moved: SkinMap, mesh: np.ndarray
) -> SlideTerm | None:
    """Find where the skin of `still` lies on `moved`, whose mesh is (V, 3); None if unknown."""
    both = still.seen & moved.seen
    inner = cv2.erode(both.astype(np.uint8), np.ones((RIM, RIM), np.uint8)).astype(np.float32)
    first, second = (np.where(both, one.grey, 128).astype(np.uint8) for one in (still, moved))
    there, back = _flow(first, second), _flow(second, first)
    chosen = (uv_map.texels % SPACING_TEXELS == SPACING_TEXELS // 2).all(1)
    ids = np.flatnonzero(chosen & (inner[tuple(uv_map.texels.T)] > 0))
    row, column = uv_map.texels[ids].T
    at = cell_to_corner(uv_map.texels[ids, ::-1])
    goal = at + there[row, column]
    missed = np.linalg.norm(goal + bilinear(back, goal) - at, axis=1)
    contrast = cv2.cornerMinEigenVal(first.astype(np.float32) / 255.0, 9, 3)[row, column]
    sure = (missed < RETURN_TEXELS) & (contrast > TEXTURED**2)
    sure &= bilinear(inner, goal) > 0.99
    ids, at, goal = ids[sure], at[sure], goal[sure]
    if not len(ids):
        return None
    samples = uv_map.samples
    places = uv_map.image((samples.at(mesh) - mesh.mean(0)).astype(np.float32))
    found, step = between(places, goal)
    home, _ = between(places, at)
    anchors = samples.some(ids)
    goals, normals = anchors.at(mesh) + found - home, sample_normals(anchors, mesh)
    return SlideTerm(anchors, np.zeros(0, int), goals, normals, SIGMA * step * REDUNDANCY**0.5)


def _flow(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the optical flow (H, W, 2), pixels, from the first picture to the second."""
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(0)
    return search.calc(first, second, np.zeros((*first.shape, 2), np.float32))
