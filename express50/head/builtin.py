"""Head models stored as one .npz file of arrays, among them the built-in head."""

from __future__ import annotations

import zipfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from express50.errors import HeadModelError
from express50.files.arrays import read_arrays
from express50.head.model import HeadModel, check_head

BUILTIN = Path(__file__).with_name("builtin.npz")
# Arrays with the names and shapes of HeadModel's fields; the names of directions are texts.
FIELDS = (
    "template", "shape_dirs", "expression_dirs", "pose_dirs", "joint_regressor", "skinning",
    "faces", "uv", "uv_faces", "landmark_faces", "landmark_bary", "shape_names",
    "expression_names",
)  # fmt: skip


@cache
def load_builtin() -> HeadModel:
    """Load the built-in head (float32, CPU). Callers share it and must not modify it."""
    return load_stored(BUILTIN, "procedural")


def load_stored(path: Path, name: str) -> HeadModel:
    """Load a head model from its arrays; docs/RECIPES.md shows how to write them.

    Args:
        path: .npz with the arrays of `FIELDS`; optionally `regions` (R, V) bool with
            `region_names` (R,), and the 17 lists of jaw line candidates, concatenated in `contour`
            with their lengths in `contour_counts`; `unit_expressions`, False where coefficients
            are standard deviations.
        name: of the model.

    Raises:
        HeadModelError: the file is damaged, lacks an array, or its arrays do not fit each other.
    """
    arrays = read_arrays(path, HeadModelError, "a stored head model", FIELDS)
    try:
        return check_head(_assembled(arrays, name))
    except (ValueError, TypeError, RuntimeError) as error:
        raise HeadModelError(
            f"{path}: not a stored head model ({error}); see docs/RECIPES.md"
        ) from (error)


def is_stored(path: Path) -> bool:
    """Return True if a file holds the arrays of a head model under our names."""
    return zipfile.is_zipfile(path) and "skinning.npy" in zipfile.ZipFile(path).namelist()


def _assembled(arrays: dict[str, np.ndarray], name: str) -> HeadModel:
    fields: dict[str, Any] = {}
    for key in FIELDS:
        kind = np.float32 if arrays[key].dtype.kind == "f" else np.int64
        names = key.endswith("_names")
        value = arrays[key]
        fields[key] = tuple(value.tolist()) if names else torch.from_numpy(value.astype(kind))
    if "contour" in arrays and "contour_counts" in arrays:
        ends = np.cumsum(arrays["contour_counts"])[:-1]
        fields["contour"] = tuple(torch.from_numpy(p) for p in np.split(arrays["contour"], ends))
    if "regions" in arrays and "region_names" in arrays:
        masks = [torch.from_numpy(mask) for mask in arrays["regions"].astype(bool)]
        fields["regions"] = dict(zip(arrays["region_names"].tolist(), masks, strict=True))
    if "unit_expressions" in arrays:
        fields["unit_expressions"] = bool(arrays["unit_expressions"])
    return HeadModel(name=name, **fields)
