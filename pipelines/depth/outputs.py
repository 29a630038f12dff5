"""Write a reconstruction: maps of every camera, the coloured mesh, metrics and a contact sheet."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from express50.dataset.depth_files import write_depth, write_normals
from express50.errors import StageError
from express50.files.images import contact_sheet, srgb_to_linear, write_image
from express50.geometry import meshes
from pipelines.depth.maps import DepthMaps, PhotoErrors, Pictures
from pipelines.depth.reconstruct import HeadSurface

ERROR_STEPS = 30.0  # 8-bit steps at the bright end of the error maps
BLANK = 24  # grey of unknown pixels
SHOWN = 4  # cameras in the contact sheet


def write_maps(
    out: Path, camera_id: str, maps: DepthMaps, depth_format: str, normal_maps: str
) -> None:
    """Write ``<camera>.png`` or ``.exr``, ``<camera>_confidence.png``, ``<camera>_normals.png``.

    Raises:
        StageError: a depth is larger than the format can hold.
    """
    try:
        write_depth(out, camera_id, maps.depth, maps.valid, depth_format)
    except ValueError as error:
        raise StageError(
            f"{camera_id}: depth up to {maps.depth.max():.4g} m does not fit"
            f" {depth_format} ({error}); if it is right, set depth.depth_format=exr32"
        ) from None
    write_image(
        out / f"{camera_id}_confidence.png", np.rint(maps.confidence * 255).astype(np.uint8)
    )
    if normal_maps != "none":
        path = out / f"{camera_id}_normals.png"
        known = maps.valid & (np.linalg.norm(maps.normals, axis=-1) > 0.5)
        write_normals(path, maps.normals, known, normal_maps)


def used_part(surface: HeadSurface) -> tuple[np.ndarray, np.ndarray]:
    """Find the vertices (U,) that faces use, and renumber the faces (F, 3) to match."""
    used = np.unique(surface.faces)
    renumber = np.zeros(len(surface.vertices), np.int32)
    renumber[used] = np.arange(len(used))
    return used, renumber[surface.faces]


def write_ply(path: Path, surface: HeadSurface) -> None:
    """Write a binary PLY: position, normal, sRGB colour, confidence; world, metres."""
    used, corners = used_part(surface)
    columns = {f"n{axis}": surface.normals[used, k] for k, axis in enumerate("xyz")}
    columns |= {c: surface.colors[used, k] for k, c in enumerate(("red", "green", "blue"))}
    columns["confidence"] = surface.confidence[used]
    meshes.write_ply(path, surface.vertices[used], corners, columns)


def write_glb(path: Path, surface: HeadSurface) -> None:
    """Write a binary glTF: position, normal, colour; world, metres.

    Colours are linear light in 8 bits: near black they are up to 6 steps of sRGB off.
    """
    used, corners = used_part(surface)
    light = np.rint(255 * srgb_to_linear(surface.colors[used] / 255.0))
    colours = np.hstack([light, np.full((len(used), 1), 255)]).astype(np.uint8)
    places, normals = surface.vertices[used], surface.normals[used]
    meshes.write_glb(path, "surface", places, corners, normals=normals, colours=colours)


def figures_of(
    surface: HeadSurface, maps: dict[str, DepthMaps], photo: dict[str, PhotoErrors]
) -> dict:
    """Collect the item's metrics, rounded so that they do not depend on the last bit."""
    errors = np.concatenate([one.errors[np.isfinite(one.errors)] for one in photo.values()])
    compared = float(np.mean([one.compared for one in photo.values()]))
    sure = {name: float(m.confidence[m.valid].mean()) for name, m in maps.items() if m.valid.any()}
    table = surface.figures | {
        "extent_m": float(np.ptp(surface.vertices[np.unique(surface.faces)], axis=0).max()),
        "coverage": float(np.mean([view.covered for view in maps.values()])),
        "coverage_worst": min(view.covered for view in maps.values()),
        "spill": float(np.mean([view.spill for view in maps.values()])),
        "confidence_mean": float(np.mean(list(sure.values()))) if sure else 0.0,
        "voxel_share": surface.figures["voxels_allocated"] / surface.figures["voxels_dense"],
        "views": len(maps),
    }
    table |= PhotoErrors(errors, compared).figures()
    cameras = {
        name: {"coverage": view.covered, "spill": view.spill, "confidence": sure.get(name, 0.0)}
        | photo[name].figures()
        for name, view in maps.items()
    }
    return {k: round(v, 5) if isinstance(v, float) else v for k, v in table.items()} | {
        "cameras": {
            name: {key: round(value, 4) for key, value in row.items()}
            for name, row in cameras.items()
        }
    }


def write_picture(
    out: Path, pictures: Pictures, maps: dict[str, DepthMaps], photo: dict[str, PhotoErrors]
) -> None:
    """Write a contact sheet of evenly chosen cameras: frame, depth, normals, confidence, errors."""
    chosen = np.unique(np.linspace(0, len(pictures) - 1, SHOWN).round().astype(int))
    rows: list[list[np.ndarray]] = [[], [], [], [], []]
    for camera, rgb, _ in (pictures[k] for k in chosen):
        view, errors = maps[camera.id], photo[camera.id].errors
        near = np.zeros_like(view.depth)
        if view.valid.any():
            low, high = np.percentile(view.depth[view.valid], [1, 99])
            near = (high - view.depth) / max(high - low, 1e-6)
        known = np.isfinite(errors)
        share = np.where(known, errors, 0) / ERROR_STEPS
        normal = (view.normals * [1, -1, -1] + 1) * 127.5
        rows[0].append(rgb)
        rows[1].append(_coloured(near, view.valid, cv2.COLORMAP_VIRIDIS))
        rows[2].append(np.where(view.valid[..., None], normal, BLANK).astype(np.uint8))
        rows[3].append((view.confidence * 255).astype(np.uint8))
        rows[4].append(_coloured(share, known, cv2.COLORMAP_INFERNO))
    labels = ["frame", "depth", "normals", "confidence", f"photo error, 0 to {ERROR_STEPS:g}/255"]
    (out / "qc").mkdir(exist_ok=True)
    sheet = contact_sheet(rows, labels, tile=(240, 240))
    write_image(out / "qc" / "surface.jpg", sheet, quality=90)


def _coloured(values: np.ndarray, known: np.ndarray, colours: int) -> np.ndarray:
    """Colour values (H, W) in [0, 1], 1 is bright; unknown pixels are grey."""
    level = (np.clip(values, 0, 1) * 255).astype(np.uint8)
    color = cv2.applyColorMap(level, colours)[..., ::-1]
    return np.where(known[..., None], color, BLANK).astype(np.uint8)
