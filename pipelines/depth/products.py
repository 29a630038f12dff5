"""Files of a reconstruction: depth, confidence and normals of every view, the coloured mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from express50.dataset.depth_files import write_depth, write_normals
from express50.errors import StageError
from express50.files.images import srgb_to_linear, write_image
from pipelines.depth.config import DepthConfig
from pipelines.depth.finish import Surface
from pipelines.depth.raycast import DepthView


def write_maps(out: Path, camera_id: str, view: DepthView, config: DepthConfig) -> None:
    """Write ``<camera>.png`` or ``.exr``, ``<camera>_confidence.png``, ``<camera>_normals.png``.

    Raises:
        StageError: a depth is over what the format holds.
    """
    try:
        write_depth(out, camera_id, view.depth, view.valid, config.depth_format)
    except ValueError as error:
        raise StageError(
            f"{camera_id}: depth up to {view.depth.max():.4g} m does not fit"
            f" {config.depth_format} ({error}); where it is right, set depth.depth_format=exr32"
        ) from None
    write_image(
        out / f"{camera_id}_confidence.png", np.rint(view.confidence * 255).astype(np.uint8)
    )
    if config.normal_maps != "none":
        path = out / f"{camera_id}_normals.png"
        known = view.valid & (np.linalg.norm(view.normals, axis=-1) > 0.5)
        write_normals(path, view.normals, known, config.normal_maps)


def used_part(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Indices (U,) of the vertices that faces use, and the faces (F, 3) numbered after them."""
    used = np.unique(surface.faces)
    renumber = np.zeros(len(surface.vertices), np.int32)
    renumber[used] = np.arange(len(used))
    return used, renumber[surface.faces]


def write_ply(path: Path, surface: Surface) -> None:
    """Binary PLY of the mesh: position, normal, sRGB colour, confidence; world, metres."""
    used, corners = used_part(surface)
    fields = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    fields += [(name, "u1") for name in ("red", "green", "blue")] + [("confidence", "<f4")]
    table = np.zeros(len(used), dtype=fields)
    for k, name in enumerate(("x", "y", "z")):
        table[name] = surface.vertices[used, k]
        table[f"n{name}"] = surface.normals[used, k]
    for k, name in enumerate(("red", "green", "blue")):
        table[name] = surface.colors[used, k]
    table["confidence"] = surface.confidence[used]
    faces = np.zeros(len(corners), dtype=[("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, corners
    kinds = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property {kinds[kind]} {name}" for name, kind in fields]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    path.write_bytes("\n".join(header).encode() + b"\n" + table.tobytes() + faces.tobytes())


def write_glb(path: Path, surface: Surface) -> None:
    """Binary glTF of the mesh: position, normal, colour; world, metres.

    glTF 2.0 (3.9.2) takes COLOR_0 for linear light, so colours are linear here, 8 bits: near black
    they are up to 6 steps of sRGB off.
    """
    import trimesh

    used, corners = used_part(surface)
    light = srgb_to_linear(surface.colors[used] / 255.0)
    opaque = np.full((len(used), 1), 255)
    skin = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(metallicFactor=0.0, roughnessFactor=0.8)
    )
    skin.vertex_attributes["color"] = np.hstack([np.rint(255 * light), opaque]).astype(np.uint8)
    mesh = trimesh.Trimesh(
        surface.vertices[used],
        corners,
        vertex_normals=surface.normals[used],
        visual=skin,
        process=False,
    )
    scene = trimesh.Scene({"surface": mesh})
    path.write_bytes(scene.export(file_type="glb", include_normals=True))
