"""Reconstruct one expression of one subject: a surface, and depth maps of every camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from express50.capture.frames import read_cameras_of, read_peak_frame
from express50.contract.layout import Dataset
from express50.contract.stage import Note, Result
from express50.dataset.tracks import read_track
from express50.errors import CaptureError, FormatError, StageError
from express50.files.images import read_alpha
from express50.head.load import load_head
from pipelines.depth.config import DepthConfig
from pipelines.depth.hull import without_contradiction
from pipelines.depth.maps import Pictures, surface_maps
from pipelines.depth.outputs import figures_of, write_glb, write_maps, write_picture, write_ply
from pipelines.depth.prior import TrackedSolid, close_mesh, matte_agreement
from pipelines.depth.reconstruct import reconstruct, tracked_surface
from pipelines.depth.views import DepthView, make_view

UNITS = (0.05, 3.0)  # metres; a surface of another size is in other units


def run(dataset: Dataset, item: str, config: DepthConfig, out: Path) -> Result:
    """Write every camera's maps, the coloured surface and a contact sheet."""
    cv2.setNumThreads(1)  # the runner counts one core per item
    fineness = config.voxel_mm, config.voxel_px, config.noise
    agreement = config.track_agreement if config.use_track else None
    subject, expression = item.split("/")
    views, pictures, dropped = read_views(dataset, item, config.image_side)
    one_camera = len(views) == 1 and not dropped  # a photograph, or a video of one camera
    if len(views) < config.min_views and not one_camera:
        why = "; ".join(f"{note.what}: {note.why}" for note in dropped)
        raise StageError(
            f"{item}: {len(views)} usable cameras, expected at least {config.min_views} with a"
            f" matte of the head ({why or 'no others are calibrated'}); run 'express50 matte'"
        )
    solid, track = read_tracked(dataset, item, views, agreement)
    if one_camera and solid is None:
        raise StageError(
            f"{item}: with one camera, depth is that of the tracked head, which was not used"
            f" ({track['why']}); run 'express50 track' and look at its overlays"
        )
    if one_camera and solid is not None:
        surface = tracked_surface(views[0], solid, *fineness)
    else:
        surface = reconstruct(views, solid, *fineness)
    extent = float(np.ptp(surface.vertices[np.unique(surface.faces)], axis=0).max())
    if not UNITS[0] < extent < UNITS[1]:
        raise StageError(
            f"{item}: the surface is {extent:.3g} m large, expected {UNITS[0]} to {UNITS[1]} m;"
            " is the calibration in metres?"
        )
    maps, photo = surface_maps(surface, pictures)
    write_ply(out / "surface.ply", surface)
    if config.glb:
        write_glb(out / "surface.glb", surface)
    for camera_id, seen in maps.items():
        write_maps(out, camera_id, seen, config.depth_format, config.normal_maps)
    write_picture(out, pictures, maps, photo)
    return Result(figures_of(surface, maps, photo) | {"track": track}, dropped)


def read_views(
    dataset: Dataset, item: str, image_side: int
) -> tuple[list[DepthView], Pictures, list[Note]]:
    """Read the usable views, their full-size pictures, and the cameras that are left out."""
    subject, expression = item.split("/")
    views: list[DepthView] = []
    pictures: Pictures = []
    dropped = []
    for camera_id, camera in read_cameras_of(dataset, subject).items():
        path = dataset.matte_file(subject, expression, camera_id)
        if not path.is_file():
            dropped.append(Note(camera_id, "it has no matte"))
            continue
        try:
            alpha = read_alpha(path).astype(np.float32) / 255
            rgb = read_peak_frame(dataset, subject, expression, camera_id)
            views.append(make_view(camera, rgb, alpha, image_side))
        except (CaptureError, FormatError, StageError) as error:
            dropped.append(Note(camera_id, str(error)))
            continue
        pictures.append((camera, rgb, alpha))
    views, contradicting = without_contradiction(views)
    gone = {note.what for note in contradicting}
    pictures = [row for row in pictures if row[0].id not in gone]
    return views, pictures, sorted([*dropped, *contradicting], key=lambda note: note.what)


def read_tracked(
    dataset: Dataset, item: str, views: list[DepthView], least: float | None
) -> tuple[TrackedSolid | None, dict]:
    """Read the tracked mesh if it agrees with the mattes, and describe it for the metrics.

    ``least`` is the share of the mesh that must lie in the mattes; None leaves the track out.
    """
    subject, expression = item.split("/")
    path = dataset.track_file(subject)
    if least is None or not path.is_file():
        return None, {"used": False, "why": "use_track" if least is None else "there is none"}
    track = read_track(path)
    if expression not in track.expressions:
        return None, {"used": False, "why": f"{expression} is not tracked"}
    vertices = track.vertices[track.row(expression)].astype(np.float64)
    faces = load_head(track.head).faces.numpy()
    if faces.max() >= len(vertices):
        raise FormatError(
            f"{path}: {len(vertices)} vertices do not fit the head's {faces.max() + 1};"
            " run 'express50 track' again"
        )
    agreement = matte_agreement(views, vertices, faces)
    if agreement < least:
        why = f"only {agreement:.0%} of it lies in the mattes, under {least:.0%}"
        return None, {"used": False, "why": why, "agreement": agreement}
    return close_mesh(vertices, faces), {"used": True, "agreement": agreement}
