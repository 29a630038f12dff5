"""Carry places from one head model to another by closest point, landmarks laid on each other."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import open3d as o3d

from express50.geometry.raycast import mesh_scene
from express50.geometry.transforms import similarity_fit
from express50.head.model import HeadModel, landmarks

INSIDE = (
    "teeth", "tongue", "mouth_interior", "left_eyeball", "right_eyeball", "left_iris", "right_iris",
    "boundary",
)  # fmt: skip
Places = tuple[np.ndarray, np.ndarray]  # faces (N,), weights (N, 3)


@lru_cache(maxsize=4)
def _skin(model: HeadModel) -> tuple[o3d.t.geometry.RaycastingScene, np.ndarray]:
    """Return the skin of a head model at rest as a scene, and the ids of its faces."""
    inside = np.any([model.regions[n].numpy() for n in INSIDE if n in model.regions], axis=0)
    faces = model.faces.numpy()
    skin = np.flatnonzero(~inside[faces].any(1))
    return mesh_scene(model.template.numpy(), faces[skin]), skin


def closest_places(model: HeadModel, points: np.ndarray) -> Places:
    """Return the places on the skin of a head model at rest nearest to points (D, 3)."""
    scene, skin = _skin(model)
    found = scene.compute_closest_points(o3d.core.Tensor(points.astype(np.float32)))
    u, v = found["primitive_uvs"].numpy().T
    weights = np.stack([1 - u - v, u, v], axis=1)
    return skin[found["primitive_ids"].numpy()], weights.astype(np.float32)


def place_points(
    model: HeadModel, places: Places, vertices: np.ndarray | None = None
) -> np.ndarray:
    """Return the points (D, 3) at places of a head model, at rest or with vertices (V, 3)."""
    mesh = model.template.double().numpy() if vertices is None else vertices
    return (mesh[model.faces.numpy()[places[0]]] * places[1][..., None]).sum(1)


def laid_on(source: HeadModel, model: HeadModel, points: np.ndarray) -> np.ndarray:
    """Move points (N, 3) of a source at rest with it, so that its landmarks lie on a model's."""
    marks = [landmarks(one, one.template[None])[0].double().numpy() for one in (source, model)]
    s, R, t = similarity_fit(*marks)
    return s * points @ R.T + t
