"""Load a head model by name or path, or its faces and regions alone, for which torch is not needed.

Importing torch takes 0.8 core seconds and 200 MB, so that it is imported with the first model.
"""

from __future__ import annotations

import zipfile
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from express50.console import log
from express50.errors import HeadModelError
from express50.files.arrays import read_arrays
from express50.files.text import expanded, open_file, refusing
from express50.head import BUILTIN_NAME, HEADS, head_path

if TYPE_CHECKING:
    from express50.head.model import HeadModel

BUILTIN = Path(__file__).with_name("builtin.npz")
# Arrays with the names and shapes of HeadModel's fields.
FIELDS = (
    "template", "shape_dirs", "expression_dirs", "pose_dirs", "joint_regressor", "skinning",
    "faces", "uv", "uv_faces", "landmark_faces", "landmark_bary", "shape_names",
    "expression_names",
)  # fmt: skip
_KINDS = (
    f'"{BUILTIN_NAME}", a FLAME .pkl, an ICT-FaceKit checkout, an .npz of its arrays, or a stored'
    " head model"
)
_log_once = cache(log)


@dataclass(frozen=True)
class HeadTopology:
    """A head model as far as labels need it: template (V, 3), faces (F, 3), masks (V,) by region.

    The fields are named as those of `HeadModel`, but are arrays.
    """

    template: np.ndarray
    faces: np.ndarray
    regions: dict[str, np.ndarray]


def load_topology(spec: str | Path) -> HeadTopology:
    """Load faces and regions of a head model; torch is imported for FLAME and ICT-FaceKit only.

    Raises:
        HeadModelError: as `load_head`.
    """
    path = BUILTIN if str(spec) == BUILTIN_NAME else head_path(spec)
    if path.suffix == ".npz" and path.is_file() and is_stored(path):
        arrays = read_arrays(path, HeadModelError, "a stored head model", FIELDS)
        faces = arrays["faces"].astype(np.int64)
        return HeadTopology(arrays["template"], faces, _region_masks(arrays))
    model = load_head(spec)
    regions = {name: mask.numpy() for name, mask in model.regions.items()}
    return HeadTopology(model.template.numpy(), model.faces.numpy(), regions)


def load_head(spec: str | Path) -> HeadModel:
    """Load a head model by name or path.

    "procedural" is the built-in head. A path that is not there is looked for by its name in the
    folders of ``EXPRESS50_HEADS``. Of paths, `*.pkl` is the user's FLAME model (with its other
    files beside it), a folder is a checkout of ICT-FaceKit, and `*.npz` holds ICT-FaceKit's arrays
    or a head model of your own (docs/RECIPES.md).

    Raises:
        HeadModelError: the name is unknown, or a file is missing or damaged.
    """
    if str(spec) == BUILTIN_NAME:
        return load_builtin()
    path = head_path(spec)
    if not path.exists():
        raise HeadModelError(
            f"head model {str(spec)!r}: no such file or folder; expected {_KINDS}. Tracks, shards"
            " and checkpoints name their model by its path: put it back there, or set the variable"
            f" {HEADS} to the folder that holds {path.name}"
        )
    if path != expanded(spec):  # only its name is known to be the right one
        _log_once(f"head model {spec} is not there, using {path}")
    if path.suffix == ".npz" and is_stored(path):
        return load_stored(path, path.stem)
    if path.suffix == ".npz" and _holds(path, "kintree_table"):
        raise HeadModelError(
            f"{path}: holds FLAME's arrays, expected FLAME's .pkl as downloaded, with its other"
            " files beside it; name that file"
        )
    if path.is_dir() or path.suffix == ".npz":
        from express50.head.ict import load_ict

        return load_ict(path)
    if path.suffix == ".pkl":
        from express50.head.flame import load_flame

        return load_flame(path)
    raise HeadModelError(f"head model {str(spec)!r}: unknown kind of file; expected {_KINDS}")


@cache
def load_builtin() -> HeadModel:
    """Load the built-in head (float32, CPU). Callers share it and must not modify it."""
    return load_stored(BUILTIN, BUILTIN_NAME)


def load_stored(path: Path, name: str) -> HeadModel:
    """Load a head model of this name from an .npz; docs/RECIPES.md shows how to write one.

    It holds the arrays of `FIELDS`. Optional are `regions` (R, V) bool with `region_names` (R,);
    the 17 lists of jaw line candidates, concatenated in `contour`, with their lengths in
    `contour_counts`; and `unit_expressions`, False if coefficients are standard deviations.

    Raises:
        HeadModelError: the file is damaged, lacks an array, or its arrays do not fit each other.
    """
    import torch

    from express50.head.model import HeadModel, check_head

    arrays = read_arrays(path, HeadModelError, "a stored head model", FIELDS)
    fields: dict[str, Any] = {}
    with refusing(HeadModelError, f"{path}: not a stored head model", "see docs/RECIPES.md"):
        for key in FIELDS:
            kind = np.float32 if arrays[key].dtype.kind == "f" else np.int64
            if key.endswith("_names"):
                fields[key] = tuple(arrays[key].tolist())
            else:
                fields[key] = torch.from_numpy(arrays[key].astype(kind))
        if "contour" in arrays and "contour_counts" in arrays:
            lines = np.split(arrays["contour"], np.cumsum(arrays["contour_counts"])[:-1])
            fields["contour"] = tuple(torch.from_numpy(line) for line in lines)
        masks = _region_masks(arrays)
        fields["regions"] = {name: torch.from_numpy(mask) for name, mask in masks.items()}
        if "unit_expressions" in arrays:
            fields["unit_expressions"] = bool(arrays["unit_expressions"])
        return check_head(HeadModel(name=name, **fields))


def _region_masks(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the masks (V,) bool of a stored head model's regions; none if it has no regions."""
    if not {"regions", "region_names"} <= arrays.keys():
        return {}
    return dict(zip(arrays["region_names"].tolist(), arrays["regions"].astype(bool), strict=True))


def is_stored(path: Path) -> bool:
    """Return whether a file holds a head model's arrays by the names of `FIELDS`."""
    return _holds(path, "skinning")


def _holds(path: Path, array: str) -> bool:
    with suppress(zipfile.BadZipFile, OSError), open_file(path) as file:
        return f"{array}.npy" in zipfile.ZipFile(file).namelist()
    return False
