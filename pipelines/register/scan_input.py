"""Read a scan and its landmarks; refuse points that cannot be a human face's."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from express50.errors import FormatError, StageError
from express50.files.text import MALFORMED, read_json, read_text, refusing
from express50.geometry.meshes import check_faces
from express50.geometry.pixels import srgb_to_linear
from express50.geometry.transforms import similarity_fit

KINDS = (".obj", ".ply", ".glb", ".stl")
UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001}
NOT_UNITS = {"kilometres": 1e3, "decimetres": 0.1, "micrometres": 1e-6}  # recognised and refused
SMALLEST_M, LARGEST_M = 0.12, 1.2  # longest side of a scan: a face, or a head with shoulders
LEAST_FACES = 500
GREY = 0.5  # of scans without colours, linear light

# Landmarks.
BESIDE = ("", "_landmarks", "_picked_points")  # added to a scan's name, the last by MeshLab
LANDMARK_KINDS = (".pp", ".json", ".csv", ".txt")
LIMIT = 1 << 20  # bytes
GIVEN_M = 0.002  # standard deviation of a given point
COUNTS = (68, 51)  # of points without names, in iBUG's order; 51 are without the jaw line
LEAST, LEAST_SPREAD_M = 4, 0.01  # points, and their distance from a line
SIZES = (0.5, 2.0)  # of a face, times the head model's
MISFIT_M = 0.03  # rms: a wide open jaw has 0.023, points that are all shifted by one have 0.032
# A face is mirrored if its mirror image's misfit is under this times its own; faces have over 1.27.
MIRRORED = 0.9
NAMES = {
    "chin": 8, "gnathion": 8, "nasion": 27, "nose_tip": 30, "pronasale": 30, "subnasale": 33,
    "right_eye_outer": 36, "right_exocanthion": 36, "right_eye_inner": 39, "right_endocanthion": 39,
    "left_eye_inner": 42, "left_endocanthion": 42, "left_eye_outer": 45, "left_exocanthion": 45,
    "mouth_right": 48, "right_cheilion": 48, "mouth_left": 54, "left_cheilion": 54,
    "upper_lip": 51, "labiale_superius": 51, "lower_lip": 57, "labiale_inferius": 57,
}  # fmt: skip
_FIX = "docs/FORMAT.md, section Scans, has the layouts"


@dataclass(frozen=True)
class Scan:
    """A scan in metres."""

    vertices: np.ndarray  # (N, 3)
    faces: np.ndarray  # (F, 3)
    colors: np.ndarray  # (N, 3) in linear light
    unit: str  # the file's, a key of UNITS
    textured: bool  # whether the file has colours


def read_scan(path: Path) -> Scan:
    """Read a scan; its unit is guessed from its size.

    Raises:
        FormatError: it is not a mesh, is damaged, is too coarse, or has no size that a head has.
    """
    import trimesh

    if path.suffix.lower() not in KINDS:
        raise FormatError(f"{path}: expected a mesh file, one of {', '.join(KINDS)}")
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
        check_faces(faces, len(vertices))
        shades = read_colours(mesh)
    except Exception as error:  # noqa: BLE001  # on damage trimesh may raise anything
        raise FormatError(f"{path}: cannot be read as a mesh ({error}); export it again") from None
    if len(faces) < LEAST_FACES:
        raise FormatError(
            f"{path}: expected at least {LEAST_FACES} triangles for a face, got {len(faces)};"
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
    """Return the vertex colours (N, 3), 0 to 255 sRGB, of a trimesh mesh; None if it has none."""
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


def landmarks_beside(scan: Path) -> Path | None:
    """Return the landmark file beside a scan, None without; FormatError if there are two."""
    names = [scan.stem + mark + kind for mark in BESIDE for kind in LANDMARK_KINDS]
    found = [path for name in names if (path := scan.with_name(name)).is_file()]
    if len(found) > 1:
        raise FormatError(f"{found[0]}: {found[1].name} has landmarks too; keep one of them")
    return found[0] if found else None


def read_landmarks(path: Path) -> np.ndarray:
    """Read landmarks (68, 3), iBUG-68 order, in the scan's unit and axes; NaN where unknown.

    Raises:
        FormatError: the layout, the number of points, a name or a coordinate is wrong.
    """
    what = f"{path}: cannot be read as landmarks of a scan"
    with refusing(FormatError, what, _FIX, (*MALFORMED, ElementTree.ParseError)):
        rows = _read_rows(path)
        points = np.full((68, 3), np.nan)
        for place, (name, xyz) in zip(_places([name for name, _ in rows]), rows, strict=True):
            if len(xyz) != 3 or not np.isfinite(xyz).all():
                raise ValueError(
                    f"point {name or place} is {xyz}, expected 3 finite numbers; name the points"
                    " and omit unknown ones"
                )
            if np.isfinite(points[place]).all():
                raise ValueError(f"point {name} appears twice")
            points[place] = xyz
    return points


def _places(names: list[str]) -> list[int]:
    """Return the indices among the 68 of points with these names; either all have one, or none."""
    count = len(names)
    numbered = [str(k) for k in range(count)], [str(k + 1) for k in range(count)]
    if count in COUNTS and (names in numbered or not any(names)):
        return list(range(68 - count, 68))
    if not names or not all(names):
        raise ValueError(f"{count} points without names, expected {COUNTS[0]} or {COUNTS[1]}")
    plain = [re.sub(r"[\s-]+", "_", name.strip().lower()) for name in names]
    places = [int(name) if name.isdecimal() else NAMES.get(name, 68) for name in plain]
    wrong = [name for name, place in zip(names, places, strict=True) if place > 67]
    if wrong:
        raise ValueError(
            f"point {wrong[0]!r}, expected a number from 0 to 67 or one of {', '.join(NAMES)}"
        )
    return places


def _read_rows(path: Path) -> list[tuple[str, tuple[float, ...]]]:
    """Read names (empty if there are none) and coordinates from MeshLab's XML, JSON or text.

    A line of text is x, y, z, perhaps after a name or a number; a header that ends in z is skipped.
    """
    if path.suffix == ".pp":
        points = ElementTree.fromstring(read_text(path, FormatError, LIMIT)).iter("point")
        kept = [point for point in points if point.get("active", "1") != "0"]
        return [(p.get("name", ""), tuple(float(p.attrib[axis]) for axis in "xyz")) for p in kept]
    if path.suffix == ".json":
        content = read_json(path, FormatError)
        pairs = content.items() if isinstance(content, dict) else (("", row) for row in content)
        return [(name, tuple(float(value) for value in row)) for name, row in pairs]
    lines = read_text(path, FormatError, LIMIT).splitlines()
    plain = [line.split("#")[0].strip(" \t,;") for line in lines]
    rows = [re.split(r"[;,\s]+", line) for line in plain if line]
    if rows and rows[0][-1][0] in "zZ":
        rows = rows[1:]
    return [("_".join(row[:-3]), tuple(map(float, row[-3:]))) for row in rows]


def check_face(points: np.ndarray, template: np.ndarray, what: str) -> None:
    """Refuse points (68, 3), metres, NaN where unknown, that do not form a face.

    The template's landmarks (68, 3) are the reference; errors call the points `what`.

    Raises:
        StageError: they are too few, on a line, of another size, mirrored or in another order.
    """
    known = np.isfinite(points).all(1)
    ours, theirs = template[known], points[known]
    centred = ours - ours.mean(0) if known.any() else np.zeros((1, 3))
    spread = np.linalg.svd(centred / np.sqrt(len(centred)), compute_uv=False)
    if known.sum() < LEAST or spread[1] < LEAST_SPREAD_M:
        raise StageError(
            f"{what}: {known.sum()} points, expected at least {LEAST} that are not on a line, such"
            " as corners of the eyes, corners of the mouth and the tip of the nose"
        )
    scale = similarity_fit(ours, theirs)[0]
    if not SIZES[0] < scale < SIZES[1]:
        raise StageError(
            f"{what} are {scale:.3g} times as far apart as those of a human face, expected"
            f" {SIZES[0]:g} to {SIZES[1]:g}; give only the head, in metres, centimetres or"
            " millimetres"
        )
    off, mirrored = _misfit(ours, theirs), _misfit(ours * [-1, 1, 1], theirs)
    if mirrored < MIRRORED * off:
        raise StageError(
            f"{what} form a mirrored face; mirror the scan back, flip its triangles, or swap"
            " left and right in your landmarks"
        )
    if off > MISFIT_M:
        raise StageError(
            f"{what}: {1e3 * off:.0f} mm (rms) from a human face's, expected at most"
            f" {1e3 * MISFIT_M:.0f}; give a face that is not inside out, and landmarks in order"
        )


def _misfit(source: np.ndarray, target: np.ndarray) -> float:
    scale, turn, shift = similarity_fit(source, target)
    off = target - scale * source @ turn.T - shift
    return float(np.sqrt((off**2).sum(1).mean()))
