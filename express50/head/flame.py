"""Load the user's own FLAME 2020 or 2023 files (Li et al. 2017); none are shipped.

Four files in one folder: the model pickle, a landmark embedding, FLAME_masks.pkl and the template
OBJ that carries the texture map. File layouts are as published loaders describe them; nothing in
the files is executed (`files/arrays.py`). Vertex and face counts are taken from the file. Teeth and
the inside of the mouth, which FLAME lacks, are added (`mouth.py`).
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import torch

from express50.errors import HeadModelError
from express50.files.arrays import read_object_array, read_pickle, to_array
from express50.head.ict import read_obj, tensor
from express50.head.model import PARENTS, REGIONS, HeadModel, check_head
from express50.head.mouth import FLAME_VERTICES, add_mouth

COMPANIONS = {
    "embedding": ("landmark_embedding.npy", "landmark_embedding_with_eyes.npy",
                  "flame_static_embedding_68.pkl"),
    "masks": ("FLAME_masks.pkl",),
    "template": ("head_template_mesh.obj", "head_template.obj"),
}  # fmt: skip
_REQUIRED = ("v_template", "f", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table")


def load_flame(path: str | Path) -> HeadModel:
    """Load FLAME, with teeth and the inside of the mouth where the file has FLAME's vertices.

    Args:
        path: The model pickle (generic_model.pkl, flame2023.pkl, ...); landmark embedding, masks
            and template are looked for beside it.

    Raises:
        HeadModelError: a file is missing, damaged, unsafe or of another layout.
    """
    model = read_flame(Path(path))
    return check_head(add_mouth(model)) if len(model.template) == FLAME_VERTICES else model


def read_flame(path: Path) -> HeadModel:
    """Read FLAME as stored, without teeth or the inside of the mouth."""
    files = _companions(path)
    arrays = read_flame_arrays(path)
    faces = arrays["f"].astype(np.int64)
    _, uv, uv_corners, uv_faces, _ = read_obj(files["template"])
    if not np.array_equal(uv_corners, faces):
        raise HeadModelError(f"{files['template']}: its faces are not those of {path.name}")
    landmark_faces, landmark_bary, contour = read_embedding(files["embedding"], faces)
    vertices, _, directions = arrays["shapedirs"].shape
    # Identity has 300 of 400 components in the published files, else three quarters.
    shapes = 300 if directions > 300 else (3 * directions) // 4
    return check_head(
        HeadModel(
            name=f"flame-{hashlib.sha256(path.read_bytes()).hexdigest()[:12]}",
            template=tensor(arrays["v_template"]),
            shape_dirs=tensor(arrays["shapedirs"][:, :, :shapes]),
            expression_dirs=tensor(arrays["shapedirs"][:, :, shapes:]),
            pose_dirs=tensor(arrays["posedirs"].reshape(vertices * 3, -1).T),
            joint_regressor=tensor(arrays["J_regressor"]),
            skinning=tensor(arrays["weights"]),
            faces=torch.from_numpy(faces),
            uv=tensor(np.clip(uv, 0.0, 1.0)),
            uv_faces=torch.from_numpy(uv_faces),
            landmark_faces=torch.from_numpy(landmark_faces),
            landmark_bary=tensor(landmark_bary),
            contour=contour,
            shape_names=tuple(f"shape{i:03d}" for i in range(shapes)),
            expression_names=tuple(f"expression{i:03d}" for i in range(directions - shapes)),
            regions=read_masks(files["masks"], arrays["v_template"]),
            unit_expressions=False,
        )
    )


def read_flame_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read and check the arrays of a FLAME model pickle; sparse and chumpy arrays made dense."""
    content = _read_dict(path)
    missing = [key for key in _REQUIRED if key not in content]
    if missing:
        raise HeadModelError(f"{path}: lacks {', '.join(missing)}; expected a FLAME model pickle")
    arrays = {key: to_array(content[key], key, str(path)) for key in _REQUIRED}
    vertices = arrays["v_template"].shape[0] if arrays["v_template"].ndim == 2 else -1
    if arrays["f"].ndim != 2 or arrays["shapedirs"].ndim != 3 or vertices < 1:
        raise HeadModelError(f"{path}: v_template, f or shapedirs does not have FLAME's shape")
    expected = {
        "v_template": (vertices, 3),
        "f": (arrays["f"].shape[0], 3),
        "shapedirs": (vertices, 3, arrays["shapedirs"].shape[-1]),
        "posedirs": (vertices, 3, 9 * (len(PARENTS) - 1)),
        "J_regressor": (len(PARENTS), vertices),
        "weights": (vertices, len(PARENTS)),
        "kintree_table": (2, len(PARENTS)),
    }
    for key, shape in expected.items():
        if arrays[key].shape != shape:
            raise HeadModelError(f"{path}: {key} has shape {arrays[key].shape}, expected {shape}")
    if not len(arrays["f"]) or arrays["f"].min() < 0 or arrays["f"].max() >= vertices:
        raise HeadModelError(f"{path}: f names vertices that the model does not have")
    parents = tuple(int(parent) for parent in arrays["kintree_table"][0, 1:])
    if parents != PARENTS[1:]:
        raise HeadModelError(f"{path}: joint parents {parents}, expected {PARENTS[1:]}")
    return arrays


def read_embedding(
    path: Path, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[torch.Tensor, ...] | None]:
    """Read a 68-landmark embedding: face ids (68,), barycentrics (68, 3), contour candidates.

    Understands the dict of DECA-style `.npy` files (full 68 or 70 points with a table of contour
    points by yaw, or 51 static points plus that table) and the 68-point pickle of TF_FLAME.
    """
    content = _read_dict(path)

    def get(*names: str) -> np.ndarray | None:
        found = next((name for name in names if name in content), None)
        return None if found is None else to_array(content[found], found, str(path))

    ids, bary = get("full_lmk_faces_idx"), get("full_lmk_bary_coords")
    if ids is None:
        ids = get("static_lmk_faces_idx", "lmk_face_idx")
        bary = get("static_lmk_bary_coords", "lmk_b_coords")
    turning, turning_bary = get("dynamic_lmk_faces_idx"), get("dynamic_lmk_bary_coords")
    if turning is not None and (turning.ndim != 2 or turning.shape[1] != 17 or not len(turning)):
        raise HeadModelError(f"{path}: the table of contour points has shape {turning.shape}")
    if turning_bary is not None and (turning is None or turning_bary.shape != (*turning.shape, 3)):
        raise HeadModelError(f"{path}: contour points lack their barycentric coordinates")
    if ids is None or bary is None or ids.size * 3 != bary.size:
        raise HeadModelError(f"{path}: no landmark face ids with barycentric coordinates")
    ids, bary = ids.reshape(-1).astype(np.int64), bary.reshape(-1, 3).astype(np.float64)
    if turning is not None and turning_bary is not None and ids.size in (51, 53):
        # Row 0 of the table is the frontal view.
        ids = np.concatenate([turning[0].astype(np.int64), ids[:51]])
        bary = np.concatenate([turning_bary[0].reshape(-1, 3), bary[:51]])
    if ids.size < 68 or bary.shape != (ids.size, 3) or ids.min() < 0 or ids.max() >= len(faces):
        raise HeadModelError(
            f"{path}: {ids.size} landmarks on faces that are not all the model's; expected 68 on "
            f"faces 0..{len(faces) - 1}"
        )
    contour = None
    if turning is not None:
        if turning.min() < 0 or turning.max() >= len(faces):
            raise HeadModelError(f"{path}: contour points on faces the model does not have")
        columns = turning.astype(np.int64).T
        contour = tuple(torch.from_numpy(np.unique(faces[column])) for column in columns)
    return ids[:68], bary[:68], contour


def read_masks(path: Path, template: np.ndarray) -> dict[str, torch.Tensor]:
    """Read masks from FLAME_masks.pkl; irises are the eyeballs' fronts, absent parts are empty."""
    content = _read_dict(path)
    regions = {name: np.zeros(len(template), dtype=bool) for name in REGIONS}
    for name in sorted(set(REGIONS) & set(content)):
        ids = to_array(content[name], name, str(path)).reshape(-1).astype(np.int64)
        if ids.size and (ids.min() < 0 or ids.max() >= len(template)):
            raise HeadModelError(f"{path}: region {name!r} names vertices the model does not have")
        regions[name][ids] = True
    missing = [name for name in ("face", "neck", "scalp", "lips") if not regions[name].any()]
    if missing:
        raise HeadModelError(f"{path}: no region {', '.join(missing)}; expected FLAME_masks.pkl")
    for side in ("left", "right"):
        ball = np.flatnonzero(regions[f"{side}_eyeball"])
        if ball.size:
            arm = template[ball] - template[ball].mean(0)
            # An iris of 6 mm radius on a ball of 12 mm spans half a radian from the axis.
            front = arm[:, 2] > np.cos(0.5) * np.linalg.norm(arm, axis=1)
            regions[f"{side}_iris"][ball[front]] = True
    return {name: torch.from_numpy(mask) for name, mask in regions.items()}


def _read_dict(path: Path) -> dict[str, Any]:
    content = read_object_array(path) if path.suffix == ".npy" else read_pickle(path)
    if not isinstance(content, dict):
        raise HeadModelError(f"{path}: holds a {type(content).__name__}, expected a dict")
    return content


def _companions(path: Path) -> dict[str, Path]:
    """Find the files that go with the model, or say in one message which are missing."""
    found, missing = {}, []
    for kind, names in COMPANIONS.items():
        file = next((path.parent / name for name in names if (path.parent / name).is_file()), None)
        if file is None:
            missing.append(" or ".join(names))
        else:
            found[kind] = file
    if missing:
        raise HeadModelError(
            f"{path}: missing beside the model: {'; '.join(missing)}. "
            "They are downloads of the FLAME project; put them into the same folder"
        )
    return found
