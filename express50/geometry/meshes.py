"""Write binary PLY files of triangle meshes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

_WORDS = {"<f4": "float", "|u1": "uchar"}


def write_ply(
    path: Path, vertices: np.ndarray, faces: np.ndarray, columns: Mapping[str, np.ndarray]
) -> None:
    """Write a little-endian PLY file of a mesh.

    Args:
        path: target.
        vertices: (V, 3), stored as float32.
        faces: (F, 3) indices.
        columns: further properties of the vertices by name, each (V,): uint8, else stored as
            float32.
    """
    values = dict(zip("xyz", vertices.T, strict=True)) | dict(columns)
    kinds = [(name, "|u1" if v.dtype == np.uint8 else "<f4") for name, v in values.items()]
    table = np.zeros(len(vertices), kinds)
    for name, value in values.items():
        table[name] = value
    rows = np.zeros(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property {_WORDS[kind]} {name}" for name, kind in kinds]
    header += [f"element face {len(rows)}", "property list uchar int vertex_indices", "end_header"]
    path.write_bytes(("\n".join(header) + "\n").encode() + table.tobytes() + rows.tobytes())
