"""Writes files in FLAME's layout, with stand-ins for the chumpy and scipy classes they name."""

from __future__ import annotations

import pickle
import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

VERTICES, SHAPES, EXPRESSIONS = 120, 6, 2
MASKS = (
    "face", "neck", "scalp", "boundary", "right_eyeball", "left_eyeball", "right_ear", "left_ear",
    "forehead", "eye_region", "nose", "lips", "right_eye_region", "left_eye_region",
)  # fmt: skip


@contextmanager
def foreign_classes() -> Iterator[tuple[type, type]]:
    """Fake `chumpy.ch.Ch` and `scipy.sparse.csc.csc_matrix`, importable only while pickling."""
    ch = type("Ch", (), {"__module__": "chumpy.ch"})
    csc = type("csc_matrix", (), {"__module__": "scipy.sparse.csc"})
    names = ("chumpy", "chumpy.ch", "scipy.sparse.csc")
    kept = {name: sys.modules.get(name) for name in names}
    for name in names:
        sys.modules[name] = types.ModuleType(name)
    sys.modules["chumpy.ch"].Ch = ch
    sys.modules["scipy.sparse.csc"].csc_matrix = csc
    try:
        yield ch, csc
    finally:
        for name, module in kept.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


def flame_dict() -> dict[str, np.ndarray]:
    """Arrays of a small FLAME with a strip of triangles for a mesh, as plain NumPy."""
    rng = np.random.default_rng(0)
    faces = np.stack([np.arange(VERTICES - 2) + k for k in range(3)], axis=1)
    regressor = np.zeros((5, VERTICES))
    for joint in range(5):
        regressor[joint, rng.choice(VERTICES, 4, replace=False)] = 0.25
    parents = np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]], dtype=np.uint32)
    return {
        "v_template": rng.normal(size=(VERTICES, 3)) * 0.1,
        "f": faces.astype(np.uint32),
        "shapedirs": rng.normal(size=(VERTICES, 3, SHAPES + EXPRESSIONS)) * 0.01,
        "posedirs": rng.normal(size=(VERTICES, 3, 36)) * 0.001,
        "J_regressor": regressor,
        "weights": rng.dirichlet(np.ones(5), size=VERTICES),
        "kintree_table": parents,
        "J": np.zeros((5, 3)),
        "bs_style": "lbs",
    }


def write_flame(folder: Path) -> Path:
    """Write model, embedding, masks and template OBJ; returns the model's path."""
    content: dict[str, object] = dict(flame_dict())
    with foreign_classes() as (ch, csc):
        shaped = ch()
        shaped.__dict__.update(x=content["shapedirs"], _dirty_vars=set())
        dense = np.asarray(content["J_regressor"])
        columns, rows = np.nonzero(dense.T)
        sparse = csc()
        sparse.__dict__.update(
            data=dense[rows, columns],
            indices=rows.astype(np.int32),
            indptr=np.searchsorted(columns, np.arange(VERTICES + 1)).astype(np.int32),
            _shape=dense.shape,
            maxprint=50,
        )
        content |= {"shapedirs": shaped, "J_regressor": sparse}
        (folder / "flame.pkl").write_bytes(pickle.dumps(content, protocol=2))
    write_embedding(folder / "landmark_embedding.npy", with_torch=True)
    masks = {name: np.arange(5) + 5 * i for i, name in enumerate(MASKS)}
    (folder / "FLAME_masks.pkl").write_bytes(pickle.dumps(masks, protocol=2))
    write_template(folder / "head_template_mesh.obj")
    return folder / "flame.pkl"


def write_embedding(path: Path, with_torch: bool) -> None:
    """A DECA-style object array; torch tensors for the table of contour points where asked."""
    rng = np.random.default_rng(1)
    faces = VERTICES - 2
    table: object = rng.integers(0, faces, (79, 17))
    table_bary: object = rng.dirichlet(np.ones(3), (79, 17)).astype(np.float32)
    if with_torch:
        import torch

        table, table_bary = torch.from_numpy(table), torch.from_numpy(table_bary)
    content = {
        "full_lmk_faces_idx": rng.integers(0, faces, (1, 68)),
        "full_lmk_bary_coords": rng.dirichlet(np.ones(3), (1, 68)),
        "dynamic_lmk_faces_idx": table,
        "dynamic_lmk_bary_coords": table_bary,
    }
    np.save(path, np.array(content, dtype=object), allow_pickle=True)


def write_template(path: Path) -> None:
    """The template OBJ with a texture map; corners "v/vt"."""
    rng = np.random.default_rng(2)
    lines = [f"v {x} {y} {z}" for x, y, z in rng.normal(size=(VERTICES, 3))]
    lines += [f"vt {u} {v}" for u, v in rng.random((VERTICES, 2))]
    lines += [f"f {i}/{i} {i + 1}/{i + 1} {i + 2}/{i + 2}" for i in range(1, VERTICES - 1)]
    path.write_text("\n".join(lines) + "\n")
