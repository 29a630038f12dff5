"""Code that makes the built-in head: a full head in FLAME's layout with named directions.

Run `python -m express50.head.generator.head` after a change here: it rewrites `builtin.npz`.

Measures are millimetres while building and metres in the result. No vertex, weight or direction is
taken from another model; the placement of features follows anthropometry (Farkas 1994).
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from express50.head.generator.expressions import expression_directions
from express50.head.generator.eyes import add_eyeball
from express50.head.generator.mesh import HalfMesh, WholeMesh, mirrored, pack_uv
from express50.head.generator.mouth import add_teeth, add_tongue
from express50.head.generator.regions import contour_candidates, embed_landmarks, region_masks
from express50.head.generator.shapes import shape_directions
from express50.head.generator.skin import add_skin, set_skin_uv
from express50.head.generator.skinning import (
    JAW,
    joint_positions,
    joint_regressor,
    pose_correctives,
    skinning_weights,
)
from express50.head.load import BUILTIN

Array = np.ndarray

PAIRED_CHARTS = ("ear", "eye_front", "eye_back")


@cache
def procedural_mesh() -> WholeMesh:
    """Build the head's geometry in millimetres, before directions; deterministic, built once."""
    half = HalfMesh()
    add_skin(half)
    add_eyeball(half)
    add_teeth(half, upper=True)
    add_teeth(half, upper=False)
    add_tongue(half)
    set_skin_uv(half)
    return mirrored(half, PAIRED_CHARTS)


def procedural_arrays() -> dict[str, Any]:
    """Make the arrays of HeadModel's fields for the built-in head (NumPy, float64, metres)."""
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


def write_builtin(path: Path) -> None:
    """Write the head's arrays as the .npz file that `express50.head.load` reads."""
    arrays = procedural_arrays()
    contour, regions = arrays.pop("contour"), arrays.pop("regions")
    stored: dict[str, Any] = {
        name: np.asarray(value, np.float32) if np.asarray(value).dtype.kind == "f" else value
        for name, value in arrays.items()
    }
    stored |= {
        "contour": np.concatenate(contour),
        "contour_counts": np.array([len(line) for line in contour]),
        "region_names": np.array(list(regions)),
        "regions": np.stack(list(regions.values())),
    }
    np.savez_compressed(path, **stored)


if __name__ == "__main__":
    write_builtin(BUILTIN)
