"""Read a given scan: its triangles in metres, and its colours."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from express50.errors import FormatError
from express50.files.images import srgb_to_linear
from express50.geometry.meshes import check_faces

KINDS = (".obj", ".ply", ".glb", ".stl")
UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001}
NOT_UNITS = {"kilometres": 1e3, "decimetres": 0.1, "micrometres": 1e-6}  # recognised and refused
SMALLEST_M, LARGEST_M = 0.12, 1.2  # longest side of a scan of a face, or of a head with shoulders
LEAST_FACES = 500
GREY = 0.5  # of scans without colours, linear light


@dataclass(frozen=True)
class Scan:
    """A scan in metres: vertices (N, 3), faces (F, 3), colors (N, 3) in linear light.

    `unit` is the one of the file, a key of UNITS; `textured` says whether the file has colours.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    unit: str
    textured: bool


def read_scan(path: Path) -> Scan:
    """Read a scan; its unit is recognised by its size.

    Raises:
        FormatError: it is not a mesh, is damaged, too coarse, or of no size that a head has.
    """
    import trimesh

    if path.suffix.lower() not in KINDS:
        raise FormatError(f"{path}: expected a mesh file, one of {', '.join(KINDS)}")
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
        check_faces(faces, len(vertices))
        shades = read_colours(mesh)
    except Exception as error:  # noqa: BLE001  # trimesh raises what the damage leads to
        raise FormatError(f"{path}: cannot be read as a mesh ({error}); export it again") from None
    if len(faces) < LEAST_FACES:
        raise FormatError(
            f"{path}: {len(faces)} triangles, expected at least {LEAST_FACES} for a face;"
            " export the scan as a triangle mesh"
        )
    if not np.isfinite(vertices[faces]).all():
        raise FormatError(f"{path}: NaN or infinity in the vertices; remove these vertices")
    used, corners = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], corners.reshape(-1, 3)
    size = float(np.ptp(vertices, axis=0).max())
    known = UNITS | NOT_UNITS
    unit = next((k for k, f in known.items() if SMALLEST_M <= size * f < LARGEST_M), None)
    if unit not in UNITS:
        raise FormatError(
            f"{path}: its longest side is {size:.4g}{f', as in {unit}' if unit else ''}; a scan of"
            f" a head has {SMALLEST_M:g} to {LARGEST_M:g} m, in {', '.join(UNITS)}: scale it, or"
            " remove everything but the head"
        )
    light = np.full((len(used), 3), GREY)
    if shades is not None:
        light = srgb_to_linear(shades[used] / 255.0)
    return Scan(vertices * UNITS[unit], faces, light, unit, shades is not None)


def read_colours(mesh: Any) -> np.ndarray | None:
    """Return colours (N, 3), 0 to 255 sRGB, of a trimesh mesh's vertices; None if it has none."""
    visual, colours = mesh.visual, None
    if visual.kind == "vertex":
        colours = visual.vertex_colors
    elif visual.kind == "texture":
        material = visual.material
        image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
        if image is not None and visual.uv is not None:
            colours = visual.to_color().vertex_colors
        else:
            colours = visual.vertex_attributes.get("color")
    if colours is None or len(colours) != len(mesh.vertices):
        return None
    return np.asarray(colours, np.float64)[:, :3]
