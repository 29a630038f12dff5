"""Write tracked heads as OBJ, PLY or GLB meshes, in the user's world, metres.

OBJ keeps the head model's vertices and their order, with texture coordinates per corner; PLY keeps
them with a colour each; GLB repeats vertices along the seams of the texture, as glTF wants them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from express50.dataset.export.select import META, SCHEMA, Head
from express50.files.atomic import dump_json
from express50.files.images import encode_png
from express50.geometry.conventions import corner_to_cell
from express50.geometry.meshes import write_glb, write_obj, write_ply
from express50.head.model import HeadModel

FORMATS = ("obj", "ply", "glb")
TEXTURE = "albedo.png"


def export_meshes(head: Head, kind: str, out: Path) -> dict:
    """Write ``<expression>.<kind>`` of every expression into ``out``; returns the meta.

    Args:
        head: what to write.
        kind: one of FORMATS.
        out: an empty folder.
    """
    if head.albedo is not None and kind == "obj":
        (out / TEXTURE).write_bytes(encode_png(head.albedo))
    for name, vertices in zip(head.track.expressions, head.track.vertices, strict=True):
        path = out / f"{name}.{kind}"
        if kind == "obj":
            write_head_obj(path, vertices, head.model, TEXTURE if head.albedo is not None else None)
        elif kind == "ply":
            colours = vertex_colours(head)
            names = () if colours is None else ("red", "green", "blue")
            columns = {name: colours[:, k] for k, name in enumerate(names)}  # type: ignore[index]
            write_ply(path, vertices, head.model.faces.numpy(), columns)
        else:
            write_head_glb(path, vertices, head.model, head.albedo)
    meta = {
        "schema": SCHEMA,
        "format": kind,
        "subject": head.subject,
        "head": head.model.name,
        "expressions": list(head.track.expressions),
        "frames": head.track.frames.tolist(),
        "textured": head.albedo is not None,
        "units": "metres",
        "world_from_export": np.eye(4).tolist(),
    }
    (out / META).write_bytes(dump_json(meta))
    return meta


def write_head_obj(
    path: Path, vertices: np.ndarray, model: HeadModel, texture: str | None = None
) -> None:
    """Write vertices (V, 3) with the head model's faces and texture coordinates as OBJ."""
    faces, uv_faces = model.faces.numpy(), model.uv_faces.numpy()
    write_obj(path, vertices, faces, model.uv.double().numpy(), uv_faces, texture)


def write_head_glb(
    path: Path, vertices: np.ndarray, model: HeadModel, albedo: np.ndarray | None
) -> None:
    """Write a binary glTF file, with the albedo (H, W, 3) uint8 sRGB as its texture."""
    from PIL import Image

    pairs = np.stack([model.faces.numpy(), model.uv_faces.numpy()], -1).reshape(-1, 2)
    unique, corners = np.unique(pairs, axis=0, return_inverse=True)
    write_glb(
        path,
        "head",
        vertices[unique[:, 0]],
        corners.reshape(-1, 3),
        uv=model.uv.numpy()[unique[:, 1]],
        baseColorTexture=None if albedo is None else Image.fromarray(albedo),
        baseColorFactor=[255, 255, 255, 255] if albedo is not None else [190, 190, 190, 255],
    )


def vertex_colours(head: Head) -> np.ndarray | None:
    """Sample the texture at the vertices: (V, 3) uint8, or None without a texture."""
    if head.albedo is None:
        return None
    height, width = head.albedo.shape[:2]
    count = len(head.model.template)
    uv = np.zeros((count, 2))
    uv[head.model.faces.numpy().ravel()] = head.model.uv.numpy()[
        head.model.uv_faces.numpy().ravel()
    ]
    places = corner_to_cell(np.stack([uv[:, 0] * width, (1 - uv[:, 1]) * height], -1))
    column, row = np.rint(places).astype(int).T
    return head.albedo[row.clip(0, height - 1), column.clip(0, width - 1)]
