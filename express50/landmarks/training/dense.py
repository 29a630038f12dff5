"""Choose the dense points: places spread over face, ears, neck and the front of the scalp.

Half of them are on the subject's left; the others are their mirror images.
"""

from __future__ import annotations

import numpy as np
import open3d as o3d

from express50.geometry.raycast import mesh_scene
from express50.head.model import HeadModel, landmarks, vertex_normals
from express50.landmarks.training.places import (
    INSIDE,
    Places,
    closest_places,
    laid_on,
    place_points,
)

# How far apart points are, as a share of what they are on the neck and scalp.
SPACING = {"face": 0.62, "nose": 0.45, "left_eye_region": 0.4, "lips": 0.35, "left_ear": 0.5}
MIDDLE_M = 0.002  # nearer to the middle a point and its mirror image would be nearly the same
NECK_M = 0.055  # of the neck, what lies further below the chin is left out: heads end differently
FORWARD = -0.2  # of the scalp, what faces further back than this is left out


def choose_places(model: HeadModel, count: int) -> Places:
    """Return places on a head model: farthest points of the left half, then their mirrors.

    Of `count` those that lie too low on the neck are left out.
    """
    rest = model.template.double().numpy()
    region = {name: mask.numpy() for name, mask in model.regions.items()}
    normals = vertex_normals(model.template[None], model.faces)[0].double().numpy()
    keep = region["face"] | region["neck"] | region["left_ear"] | region["scalp"]
    keep &= (rest[:, 0] > MIDDLE_M) & ~np.any([region[n] for n in INSIDE if n in region], axis=0)
    keep &= ~region["scalp"] | (normals[:, 2] > FORWARD)
    keep &= np.isin(np.arange(len(rest)), _outer(model))
    spacing = np.ones(len(rest))
    for name, share in SPACING.items():
        spacing[region[name]] = share
    ids = np.flatnonzero(keep)
    chosen = [int(ids[np.argmax(rest[ids, 2])])]  # the tip of the nose, or beside it
    distance = np.full(len(ids), np.inf)
    while len(chosen) < count // 2:
        step = np.linalg.norm(rest[ids] - rest[chosen[-1]], axis=1)
        distance = np.minimum(distance, step / spacing[ids])
        chosen.append(int(ids[np.argmax(distance)]))
    low = landmarks(model, model.template[None])[0, 8, 1].item() - NECK_M
    left = np.array([place for place in rest[chosen] if place[1] > low])
    return closest_places(model, np.concatenate([left, left * (-1.0, 1.0, 1.0)]))


def _outer(model: HeadModel) -> np.ndarray:
    """Return the vertices that can be seen from outside, on a straight way along their normals."""
    vertices = model.template.numpy()
    normals = vertex_normals(model.template[None], model.faces)[0].numpy()
    rays = np.concatenate([vertices + 4e-4 * normals, normals], axis=1).astype(np.float32)
    blocked = mesh_scene(vertices, model.faces.numpy()).test_occlusions(o3d.core.Tensor(rays))
    return np.flatnonzero(~blocked.numpy())


def carry_places(source: HeadModel, places: Places, model: HeadModel) -> Places:
    """Return the places of another head model that lie where a source's lie, both at rest."""
    return closest_places(model, laid_on(source, model, place_points(source, places)))
