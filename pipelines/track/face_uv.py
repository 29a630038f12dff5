"""Landmarks on the face UV map: they slide the mesh along the skin to where it belongs.

Patches say how far the skin lies before or behind the mesh, not that a corner of the mouth sits a
millimetre too far out. So the pictures are projected onto the current mesh, unwrapped to the face
UV map, and landmarks are found there again: if a corner of the mouth appears beside its texel, the
mesh moves by that much.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch

from express50.geometry.conventions import corner_to_cell
from express50.geometry.sampling import bilinear
from express50.head.model import HeadModel, vertex_normals
from express50.landmarks.network import LandmarkNet, load_network
from pipelines.track.appearance import robust_mean
from pipelines.track.config import UV_WEIGHTS
from pipelines.track.crops import FrameSetCrops, look_up, root_light
from pipelines.track.face_uv_map import (
    FIRST,
    HEIGHT,
    LIPS_APART,
    WIDTH,
    FaceUvMap,
    mark_places,
    read_marks,
)
from pipelines.track.state import Target
from pipelines.track.surface import Visibility, sample_normals, view_weights
from pipelines.track.terms import SlideTerm, landmark_anchors

REDUNDANCY = 2.0  # neighbouring landmarks err together: so many count as one
FLOOR_M = 0.0004
VIEW_NOISE = 0.05  # standard deviation of root light between views of one place
LEAST_SEEN, LEAST_VIEWS = 0.1, 2
# Landmarks of whole heads are coarser and err differently in every expression: those that the map
# shows get so many times their standard deviation. The others, as corners of open mouths, stay.
DISTRUST = 6.0
TORN_M = 0.004  # texels further apart than this lie on two sides of a gap, as between open lips


def with_slide(target: Target, slide: SlideTerm | None) -> Target:
    """Add a reading of the map, and trust the landmarks less that it contains."""
    if slide is None:
        return target
    sigma = target.sigma.copy()
    sigma[:, slide.marks] *= DISTRUST
    return replace(target, sigma=sigma, terms=(*target.terms, slide))


def slide_term(
    model: HeadModel, uv_map: FaceUvMap, pictures: FrameSetCrops, mesh: np.ndarray
) -> SlideTerm | None:
    """Find where one frame set's skin belongs; None if too little is seen.

    Args:
        model: the head.
        uv_map: of its face.
        pictures: of the frame set.
        mesh: (V, 3) of the fit so far, world.
    """
    colors, mass = unwrap(model, uv_map, pictures, mesh)
    if not (mass > LEAST_SEEN).any():
        return None
    at, error = read_marks(uv_network(), colors)
    rims = LIPS_APART[FIRST:]
    # Single precision is for places about the head, not for those of the world.
    places = uv_map.image((uv_map.samples.at(mesh) - mesh.mean(0)).astype(np.float32))
    found, step = _between(places, at + rims)
    home, home_step = _between(places, mark_places() + rims)
    seen = bilinear((mass > LEAST_SEEN).astype(np.float32), at + rims)
    good = np.flatnonzero((seen > 0.99) & (np.maximum(step, home_step) < TORN_M))
    if not len(good):
        return None
    anchors = landmark_anchors(model).some(good + FIRST)
    # The map rounds off where landmarks lie, but shows well how far they have moved.
    goals = anchors.at(mesh) + found[good] - home[good]
    normals = anchors.at(vertex_normals(torch.from_numpy(mesh)[None], model.faces)[0].numpy())
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    sigma = np.hypot(error[good] * step[good], FLOOR_M) * REDUNDANCY**0.5
    return SlideTerm(anchors, good + FIRST, goals, normals, sigma)


def unwrap(
    model: HeadModel, uv_map: FaceUvMap, pictures: FrameSetCrops, mesh: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Project the pictures onto the map: root light (HEIGHT, WIDTH, 3), and its weight (H, W).

    Places seen by fewer than two views count as unseen: one view cannot distinguish a move along
    the skin from one off it.
    """
    places, normals = uv_map.samples.at(mesh), sample_normals(uv_map.samples, mesh)
    weights = view_weights(Visibility(mesh, model.faces.numpy()), pictures, places, normals)
    values = np.zeros((*weights.shape, 3))
    for row, crop in enumerate(pictures.crops):
        chosen = np.flatnonzero(weights[row])
        image, camera = root_light(crop)
        values[row, chosen] = look_up(camera, image, places[chosen])
    trust = weights**2 * ((weights > 0).sum(0) >= LEAST_VIEWS)
    colors = robust_mean(values, np.ones_like(values), trust, VIEW_NOISE)
    mass = trust.sum(0)[:, None].astype(np.float32)
    return uv_map.image(colors.astype(np.float32)), uv_map.image(mass)[..., 0]


def _between(places: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate places (S, 3) at texels (S, 2); also the longest step (S,) between texels."""
    column, row = np.clip(corner_to_cell(at), 0, (WIDTH - 2, HEIGHT - 2)).astype(np.int64).T
    a, b = places[row, column], places[row, column + 1]
    c, d = places[row + 1, column], places[row + 1, column + 1]
    steps = [np.linalg.norm(x - y, axis=1) for x, y in ((a, b), (c, d), (a, c), (b, d))]
    return bilinear(places, at).astype(np.float64), np.max(steps, axis=0)


@lru_cache(maxsize=1)
def uv_network() -> LandmarkNet:
    """Read the shipped network once."""
    return load_network(UV_WEIGHTS)
