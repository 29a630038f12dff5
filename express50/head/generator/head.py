"""The built-in head, made by code: a full head in FLAME's layout with named directions.

Measures are millimetres while building and metres in the result. No vertex, weight or direction is
taken from another model; the placement of features follows anthropometry (Farkas 1994).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import torch

from express50.head.generator.expressions import expression_directions
from express50.head.generator.eyes import add_eyeball
from express50.head.generator.landmarks import contour_candidates, embed_landmarks
from express50.head.generator.mesh import HalfMesh, WholeMesh, mirrored
from express50.head.generator.regions import region_masks
from express50.head.generator.shapes import shape_directions
from express50.head.generator.skin import add_skin, set_skin_uv
from express50.head.generator.skinning import (
    JAW,
    joint_positions,
    joint_regressor,
    pose_correctives,
    skinning_weights,
)
from express50.head.generator.teeth import add_teeth, add_tongue
from express50.head.generator.uv import pack_uv
from express50.head.model import HeadModel, check_head

Array = np.ndarray

PAIRED_CHARTS = ("ear", "eye_front", "eye_back")


@cache
def procedural_mesh() -> WholeMesh:
    """Geometry of the head in millimetres, before directions; deterministic, built once."""
    half = HalfMesh()
    add_skin(half)
    add_eyeball(half)
    add_teeth(half, upper=True)
    add_teeth(half, upper=False)
    add_tongue(half)
    set_skin_uv(half)
    return mirrored(half, PAIRED_CHARTS)


def procedural_arrays() -> dict[str, Any]:
    """All arrays of the built-in head (NumPy, float64, metres), keyed as HeadModel's fields."""
    mesh = procedural_mesh()
    regions = region_masks(mesh)
    joints = joint_positions(mesh)
    uv, uv_faces = pack_uv(mesh)
    landmark_faces, landmark_bary = embed_landmarks(mesh)
    weights = skinning_weights(mesh, regions)
    shape_names, shapes = shape_directions(mesh, regions, weights[:, JAW])
    expression_names, expressions = expression_directions(mesh, regions, weights)
    return {
        "template": mesh.vertices / 1000,
        "shape_dirs": shapes / 1000,
        "shape_names": shape_names,
        "expression_dirs": expressions / 1000,
        "expression_names": expression_names,
        "pose_dirs": pose_correctives(mesh, regions) / 1000,
        "joint_regressor": joint_regressor(mesh, joints),
        "skinning": weights,
        "faces": mesh.faces,
        "uv": uv,
        "uv_faces": uv_faces,
        "landmark_faces": landmark_faces,
        "landmark_bary": landmark_bary,
        "contour": contour_candidates(mesh),
        "regions": regions,
    }


@cache
def build_procedural_head() -> HeadModel:
    """The built-in head as a HeadModel (float32, CPU). Cached: callers share it, do not modify."""
    arrays = procedural_arrays()

    def tensor(value: Array) -> torch.Tensor:
        kind = torch.float32 if value.dtype.kind == "f" else None
        return torch.as_tensor(np.ascontiguousarray(value), dtype=kind)

    model = HeadModel(
        name="procedural",
        contour=tuple(tensor(line) for line in arrays.pop("contour")),
        regions={name: tensor(mask) for name, mask in arrays.pop("regions").items()},
        shape_names=tuple(arrays.pop("shape_names")),
        expression_names=tuple(arrays.pop("expression_names")),
        **{name: tensor(value) for name, value in arrays.items()},
    )
    return check_head(model)
