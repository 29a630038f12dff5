"""Reconstruct one expression of one subject and write maps, the mesh, metrics and a sheet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from express50.capture.frames import read_cameras_of, read_matted_frame
from express50.console import count
from express50.contract.layout import Dataset
from express50.contract.stage import Note, Result
from express50.dataset.depth_files import encode_depth, encode_normals, write_depth
from express50.dataset.tracks import read_track
from express50.error_model import error_models, expect, single_camera_sigma
from express50.errors import UNREADABLE, StageError, advised
from express50.files.images import write_image
from express50.geometry.meshes import encode_glb, write_surface
from express50.geometry.pixels import contact_sheet, shrink, srgb_to_linear
from express50.geometry.sampling import evenly
from express50.head.load import load_topology
from pipelines.depth.maps import (
    DepthMaps,
    PhotoErrors,
    Picture,
    has_normal,
    picture_of,
    surface_maps,
)
from pipelines.depth.prior import TrackedSolid, bare_triangles, close_mesh, matte_agreement
from pipelines.depth.reconstruct import reconstruct, tracked_surface
from pipelines.depth.surface import HeadSurface
from pipelines.depth.views import DepthView, make_view, with_face, without_contradiction
from pipelines.regions.geometry import head_labels, make_head
from pipelines.regions.things import face_views

SHARE_OF_LEVEL = np.arange(256, dtype=np.float32) / 255
ERROR_STEPS = 30.0  # 8-bit steps at the bright end of the error maps
BLANK = 24  # grey of unknown pixels
SHOWN = 4  # cameras in the contact sheet
TILE = 240  # pixels of a picture in it
ERROR_STRIDE = 8  # every n-th pixel counts for the expected error
AGREEMENT = 0.85  # share of the tracked mesh that must lie in the mattes for it to be used


def run(
    dataset: Dataset, item: str, out: Path, *, voxel_mm: float, voxel_px: float, image_side: int,
    noise: float,
) -> Result:  # fmt: skip
    """Write every camera's maps, the coloured surface and a contact sheet.

    Raises:
        StageError: there are too few usable views, or one view without a tracked head.
    """
    cv2.setNumThreads(1)  # the runner counts one core per item
    views, pictures, dropped = read_views(dataset, item, image_side)
    # One camera of which nothing was dropped is a photograph, or a video.
    if not views or (len(views) == 1 and dropped):
        why, least = "; ".join(map(str, dropped)), 1 if len(dropped) == 1 and not views else 2
        raise StageError(
            f"{item}: {count(len(views), 'camera')} with a matte of the head, expected at least"
            f" {least} ({why or 'no others are calibrated'}); run"
            f" {advised('express50 matte', dataset.root)}"
        )
    views, solid, track = read_tracked(dataset, item, views)
    if len(views) > 1:
        surface = reconstruct(views, solid, voxel_mm, voxel_px, noise)
    elif solid is not None:
        surface = tracked_surface(views[0], solid, voxel_mm, voxel_px, noise)
    else:
        raise StageError(
            f"{item}: with one camera, depth is that of the tracked head, which was not used"
            f" ({track['why']}); run {advised('express50 track', dataset.root)} and look at its"
            " overlays"
        )
    write_meshes(out, surface)
    rows, photo, typical = write_views(out, surface, pictures, solid)
    shared = single_camera_sigma([picture.camera for picture in pictures], surface.vertices)
    expected = expect(error_models()["depth"], typical, float(np.median(shared)))
    figures = figures_of(surface, rows, photo) | {"track": track}
    return Result(figures, dropped, expected_error=expected)


def write_views(
    out: Path, surface: HeadSurface, pictures: Sequence[Picture], solid: TrackedSolid | None
) -> tuple[dict[str, dict], list[PhotoErrors], np.ndarray]:
    """Write every camera's maps and a contact sheet of evenly chosen cameras.

    Returns each camera's figures, its photometric errors, and the typical errors of all pixels.
    """
    chosen = evenly(range(len(pictures)), SHOWN)
    rows, photo, typical, columns = {}, [], [], []
    views = surface_maps(surface, pictures, solid)
    for number, (camera_id, seen, errors) in enumerate(views):
        write_maps(out, camera_id, seen)
        rows[camera_id] = view_figures(seen, errors)
        photo.append(errors)
        if seen.bounds is not None:
            typical.append(seen.bounds.typical[::ERROR_STRIDE].astype(np.float32))
        if number in chosen:
            columns.append(view_panels(pictures[number].small[1], seen, errors.errors))
    labels = ["frame", "depth", "normals", "confidence", f"photo error, 0 to {ERROR_STEPS:g}/255"]
    (out / "qc").mkdir(exist_ok=True)
    table = [list(row) for row in zip(*columns, strict=True)]
    sheet = contact_sheet(table, labels, tile=(TILE, TILE))
    write_image(out / "qc" / "surface.jpg", sheet, quality=90)
    return rows, photo, np.concatenate(typical)


def read_views(
    dataset: Dataset, item: str, image_side: int
) -> tuple[list[DepthView], list[Picture], list[Note]]:
    """Read the usable views, describe their pictures, and name the cameras that are left out."""
    views: list[DepthView] = []
    pictures: list[Picture] = []
    dropped = []
    for camera_id, camera in read_cameras_of(dataset, item.split("/")[0]).items():
        try:
            rgb, alpha = read_matted_frame(dataset, item, camera)
            views.append(make_view(camera, rgb, cv2.LUT(alpha, SHARE_OF_LEVEL), image_side))
            pictures.append(picture_of(camera, rgb, alpha))
        except UNREADABLE as error:
            dropped.append(Note(camera_id, str(error)))
    views, contradicting = without_contradiction(views)
    gone = {note.what for note in contradicting}
    pictures = [picture for picture in pictures if picture.camera.id not in gone]
    return views, pictures, sorted([*dropped, *contradicting], key=lambda note: note.what)


def read_tracked(
    dataset: Dataset, item: str, views: list[DepthView]
) -> tuple[list[DepthView], TrackedSolid | None, dict]:
    """Read the tracked mesh if it agrees with the mattes, and describe it for the metrics.

    Also returns the views, with the parts of the face that their mattes lack.
    """
    subject, expression = item.split("/")
    path = dataset.track_file(subject)
    if not path.is_file():
        return views, None, {"used": False, "why": "it is not tracked"}
    track = read_track(path)
    if expression not in track.expressions:
        return views, None, {"used": False, "why": f"{expression} is not tracked"}
    model = load_topology(track.head)
    vertices, faces = track.mesh(expression, len(model.template), path), model.faces
    agreement = matte_agreement(views, vertices, faces)
    if agreement < AGREEMENT:
        why = f"only {agreement:.0%} of it lies in the mattes, under {AGREEMENT:.0%}"
        return views, None, {"used": False, "why": why, "agreement": agreement}
    head = make_head(vertices, track.R[track.row(expression)], head_labels(model))
    views = [with_face(view, head) for view in views]
    found = face_views(head, [(view.camera, view.rgb, view.alpha) for view in views])
    solid, glasses = close_mesh(vertices, faces), track.glasses_in(expression)
    if found:
        solid = replace(solid, face_views=tuple(found))
    else:
        solid = replace(solid, bare=bare_triangles(model))
    if glasses is not None:
        solid = replace(solid, glasses=glasses)
    used = {"used": True, "agreement": agreement}
    seen = {"glasses": len(solid.glasses) > 0, "things": len(found) > 0}
    return views, solid, used | seen


def write_maps(out: Path, camera_id: str, maps: DepthMaps) -> None:
    """Write ``<camera>.png`` or ``.exr``, ``<camera>_confidence.png``, ``<camera>_normals.png``.

    Raises:
        StageError: the depth is more than any file holds.
    """
    try:
        depth = encode_depth(maps.depth, maps.valid)
    except ValueError as error:
        raise StageError(f"{camera_id}: {error}") from None
    write_depth(out, camera_id, maps.whole(depth))
    confidence = np.rint(maps.confidence * 255).astype(np.uint8)
    write_image(out / f"{camera_id}_confidence.png", maps.whole(confidence))
    known = has_normal(maps.normals)  # the surface has none where its triangles fold back
    normals = encode_normals(maps.normals, known)
    write_image(out / f"{camera_id}_normals.png", maps.whole(normals))


def write_meshes(out: Path, surface: HeadSurface) -> None:
    """Write surface.ply and surface.glb; world, metres.

    Colours of the glTF are linear light in 8 bits: near black they are up to 6 steps of sRGB off.
    """
    vertices, faces, normals = surface.vertices, surface.faces, surface.normals
    write_surface(out / "surface.ply", vertices, faces, normals, surface.colors, surface.confidence)
    light = np.rint(255 * srgb_to_linear(surface.colors / 255.0))
    colours = np.hstack([light, np.full((len(light), 1), 255)]).astype(np.uint8)
    glb = encode_glb("surface", vertices, faces, normals=normals, colours=colours)
    (out / "surface.glb").write_bytes(glb)


def figures_of(surface: HeadSurface, rows: dict[str, dict], photo: Sequence[PhotoErrors]) -> dict:
    """Collect the item's metrics, rounded so that they do not depend on the last bit."""
    errors = np.concatenate([one.errors[np.isfinite(one.errors)] for one in photo])
    compared = float(np.mean([one.compared for one in photo]))
    covered = [row["coverage"] for row in rows.values()]
    table = surface.figures | PhotoErrors(errors, compared).figures() | {
        "coverage": float(np.mean(covered)),
        "coverage_worst": min(covered),
        "spill": float(np.mean([row["spill"] for row in rows.values()])),
        "voxel_share": surface.figures["voxels_allocated"] / surface.figures["voxels_dense"],
        "views": len(rows),
    }  # fmt: skip
    cameras = {name: {k: round(v, 4) for k, v in row.items()} for name, row in rows.items()}
    rounded = {k: round(v, 5) if isinstance(v, float) else v for k, v in table.items()}
    return rounded | {"cameras": cameras}


def view_figures(view: DepthMaps, photo: PhotoErrors) -> dict[str, float]:
    """Summarise one camera's maps for the metrics."""
    sure = float(view.confidence[view.valid].mean()) if view.valid.any() else 0.0
    row = {"coverage": view.covered, "spill": view.spill, "confidence": sure}
    if view.bounds is not None and view.valid.any():
        row["bound_mm_median"] = float(np.median(view.bounds.bound))
    return row | photo.figures()


def view_panels(rgb: np.ndarray, view: DepthMaps, errors: np.ndarray) -> list[np.ndarray]:
    """Draw frame, depth, normals, confidence and photometric errors (h, w) of a camera."""
    step = max(1, max(view.size) // (2 * TILE))  # of pixels: the sheet shows no more
    depth, valid, normals, sure = (
        view.whole(values)[::step, ::step]
        for values in (view.depth, view.valid, view.normals, view.confidence)
    )
    near = np.zeros_like(depth)
    if valid.any():
        low, high = np.percentile(depth[valid], [1, 99])
        near = (high - depth) / max(high - low, 1e-6)
    known = np.isfinite(errors)
    normal = (normals * [1, -1, -1] + 1) * 127.5
    return [
        shrink(rgb, 2 * TILE),
        _coloured(near, valid, cv2.COLORMAP_VIRIDIS),
        np.where(valid[..., None], normal, BLANK).astype(np.uint8),
        (sure * 255).astype(np.uint8),
        _coloured(np.where(known, errors, 0) / ERROR_STEPS, known, cv2.COLORMAP_INFERNO),
    ]


def _coloured(values: np.ndarray, known: np.ndarray, colours: int) -> np.ndarray:
    """Colour values (H, W) in [0, 1], 1 is bright; unknown pixels are grey."""
    level = (np.clip(values, 0, 1) * 255).astype(np.uint8)
    color = cv2.applyColorMap(level, colours)[..., ::-1]
    return np.where(known[..., None], color, BLANK).astype(np.uint8)
