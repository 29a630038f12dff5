"""Load the user's own FLAME 2020 or 2023 files (Li et al. 2017); none are shipped.

They are four files in one folder: the model pickle, a landmark embedding, FLAME_masks.pkl and the
template OBJ with the texture map, laid out as published loaders describe. Nothing in the files is
executed (`files/arrays.py`). Any numbers of vertices and faces are accepted. Teeth and the inside
of the mouth, which FLAME lacks, are added (`mouth.py`).
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import torch

from express50.errors import HeadModelError
from express50.files.arrays import read_object_array, read_pickle, to_array
from express50.head import COMPANIONS, companions
from express50.head.ict import read_obj, tensor
from express50.head.model import PARENTS, REGIONS, HeadModel, check_head
from express50.head.mouth import FLAME_VERTICES, add_mouth

_REQUIRED = ("v_template", "f", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table")


def load_flame(path: str | Path) -> HeadModel:
    """Load FLAME; add teeth and the inside of the mouth if it has FLAME's number of vertices.

    `path` is the model pickle (generic_model.pkl, flame2023.pkl, ...); landmark embedding, masks
    and template must be beside it.

    Raises:
        HeadModelError: a file is missing, damaged, unsafe or has another layout.
    """
    model = read_flame(Path(path))
    return check_head(add_mouth(model)) if len(model.template) == FLAME_VERTICES else model


def read_flame(path: Path) -> HeadModel:
    """Read FLAME as stored, without teeth or the inside of the mouth."""
    files = companions(path)
    missing = [" or ".join(names) for kind, names in COMPANIONS.items() if kind not in files]
    if missing:
        raise HeadModelError(
            f"{path}: missing beside the model: {'; '.join(missing)}; download them from the FLAME"
            " project into the same folder"
        )
    arrays = read_flame_arrays(path)
    faces = arrays["f"].astype(np.int64)
    _, uv, uv_corners, uv_faces, _ = read_obj(files["template"])
    if not np.array_equal(uv_corners, faces):
        raise _refusal(files["template"], f"its faces are not those of {path.name}")
    landmark_faces, landmark_bary, contour = read_embedding(files["embedding"], faces)
    vertices, _, directions = arrays["shapedirs"].shape
    # Identity has 300 of the published files' 400 directions; in other files, three quarters.
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
    """Read and check the arrays of a FLAME model pickle; make sparse and chumpy arrays dense."""
    content = _read_dict(path)
    missing = [key for key in _REQUIRED if key not in content]
    if missing:
        raise _refusal(path, f"lacks {', '.join(missing)}, expected a FLAME model pickle")
    arrays = {key: to_array(content[key], key, str(path)) for key in _REQUIRED}
    vertices = arrays["v_template"].shape[0] if arrays["v_template"].ndim == 2 else -1
    if arrays["f"].ndim != 2 or arrays["shapedirs"].ndim != 3 or vertices < 1:
        raise _refusal(path, "v_template, f or shapedirs does not have FLAME's shape")
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
            raise _refusal(path, f"{key} has shape {arrays[key].shape}, expected {shape}")
    if not len(arrays["f"]) or arrays["f"].min() < 0 or arrays["f"].max() >= vertices:
        raise _refusal(path, "f names vertices that the model does not have")
    parents = tuple(int(parent) for parent in arrays["kintree_table"][0, 1:])
    if parents != PARENTS[1:]:
        raise _refusal(path, f"joint parents {parents}, expected {PARENTS[1:]}")
    return arrays


def read_embedding(
    path: Path, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[torch.Tensor, ...] | None]:
    """Read a 68-landmark embedding: face ids (68,), barycentrics (68, 3), contour candidates.

    Accepts the dict of `.npy` files (68 or 70 points, or 51 points with a table of contour points
    by yaw) and the 68-point pickle of TF_FLAME.
    """
    content = _read_dict(path)

    def get(*names: str) -> np.ndarray | None:
        found = next((name for name in names if name in content), None)
        return None if found is None else to_array(content[found], found, str(path))

    ids, bary = get("full_lmk_faces_idx"), get("full_lmk_bary_coords")
    if ids is None:
        ids = get("static_lmk_faces_idx", "lmk_face_idx")
        bary = get("static_lmk_bary_coords", "lmk_b_coords")
    by_yaw, yaw_bary = get("dynamic_lmk_faces_idx"), get("dynamic_lmk_bary_coords")
    if by_yaw is not None and (by_yaw.ndim != 2 or by_yaw.shape[1] != 17 or not len(by_yaw)):
        raise _refusal(path, f"contour points have shape {by_yaw.shape}, expected (yaws, 17)")
    if yaw_bary is not None and (by_yaw is None or yaw_bary.shape != (*by_yaw.shape, 3)):
        raise _refusal(path, "contour points lack barycentric coordinates")
    if ids is None or bary is None or ids.size * 3 != bary.size:
        raise _refusal(path, "no landmark face ids with barycentric coordinates")
    ids, bary = ids.reshape(-1).astype(np.int64), bary.reshape(-1, 3).astype(np.float64)
    if by_yaw is not None and yaw_bary is not None and ids.size in (51, 53):
        # Row 0 of the table is the frontal view.
        ids = np.concatenate([by_yaw[0].astype(np.int64), ids[:51]])
        bary = np.concatenate([yaw_bary[0].reshape(-1, 3), bary[:51]])
    if ids.size < 68 or bary.shape != (ids.size, 3) or ids.min() < 0 or ids.max() >= len(faces):
        what = f"{ids.size} landmarks on faces that are not all the model's, expected 68 on faces"
        raise _refusal(path, f"{what} 0..{len(faces) - 1}")
    contour = None
    if by_yaw is not None:
        if by_yaw.min() < 0 or by_yaw.max() >= len(faces):
            raise _refusal(path, "contour points on faces that the model does not have")
        columns = by_yaw.astype(np.int64).T
        contour = tuple(torch.from_numpy(np.unique(faces[column])) for column in columns)
    return ids[:68], bary[:68], contour


def read_masks(path: Path, template: np.ndarray) -> dict[str, torch.Tensor]:
    """Read masks (V,) bool by region; irises are the fronts of the eyeballs, some may be empty."""
    content = _read_dict(path)
    regions = {name: np.zeros(len(template), dtype=bool) for name in REGIONS}
    for name in sorted(set(REGIONS) & set(content)):
        ids = to_array(content[name], name, str(path)).reshape(-1).astype(np.int64)
        if ids.size and (ids.min() < 0 or ids.max() >= len(template)):
            raise _refusal(path, f"region {name!r} names vertices that the model does not have")
        regions[name][ids] = True
    missing = [name for name in ("face", "neck", "scalp", "lips") if not regions[name].any()]
    if missing:
        raise _refusal(path, f"no region {', '.join(missing)}, expected FLAME_masks.pkl")
    for side in ("left", "right"):
        ball = np.flatnonzero(regions[f"{side}_eyeball"])
        if ball.size:
            arm = template[ball] - template[ball].mean(0)
            # An iris of 6 mm radius on a ball of 12 mm spans half a radian from the axis.
            front = arm[:, 2] > np.cos(0.5) * np.linalg.norm(arm, axis=1)
            regions[f"{side}_iris"][ball[front]] = True
    return {name: torch.from_numpy(mask) for name, mask in regions.items()}


def _refusal(path: Path, what: str) -> HeadModelError:
    return HeadModelError(f"{path}: {what}; use the files of one version of FLAME, as downloaded")


def _read_dict(path: Path) -> dict[str, Any]:
    content = read_object_array(path) if path.suffix == ".npy" else read_pickle(path)
    if not isinstance(content, dict):
        raise _refusal(path, f"holds a {type(content).__name__}, expected a dict")
    return content
