"""The depth stage: one expression of one subject, a surface and a depth map for every camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from express50.capture.frames import peak_items, read_cameras_of, read_frame, read_peaks
from express50.capture.index import index_path
from express50.contract.layout import Dataset
from express50.contract.stage import Stage
from express50.dataset.tracks import read_track
from express50.errors import CaptureError, FormatError, StageError
from express50.files.images import read_alpha
from express50.geometry.raycast import mesh_scene
from express50.head.load import load_head
from pipelines.depth.config import PRESETS, DepthConfig
from pipelines.depth.consistency import Agreement, agreements, make_shot, vouched
from pipelines.depth.finish import Surface
from pipelines.depth.grid import View
from pipelines.depth.prior import Prior, make_prior, matte_agreement
from pipelines.depth.products import write_glb, write_maps, write_ply
from pipelines.depth.qc import Pictures, metrics, write_picture
from pipelines.depth.raycast import DepthView, cast_view
from pipelines.depth.reconstruct import reconstruct, tracked_surface
from pipelines.depth.views import make_view, without_contradiction

UNITS = (0.05, 3.0)  # metres; a head's box outside this range means other units than metres


def inputs(dataset: Dataset, item: str, config: DepthConfig) -> dict[str, Path | str]:
    """Index, cameras, the expression's peak and mattes, and the track where there is one."""
    subject, expression = item.split("/")
    found: dict[str, Path | str] = {
        "index": index_path(dataset, subject),
        "cameras": dataset.item_dir("calibrate", subject) / "cameras.json",
        "frame": str(read_peaks(dataset, subject)[expression]),
    }
    for camera in read_cameras_of(dataset, subject):
        path = dataset.matte_file(subject, expression, camera)
        if path.is_file():
            found[f"matte {camera}"] = path
    track = dataset.item_dir("track", subject) / "track.npz"
    if config.use_track and track.is_file():
        found["track"] = track
    return found


def run(dataset: Dataset, item: str, config: DepthConfig, out: Path) -> dict:
    """Write maps of every camera, the coloured surface and a picture; returns the numbers."""
    cv2.setNumThreads(1)  # the runner counts one core an item
    subject, expression = item.split("/")
    frame = read_peaks(dataset, subject)[expression]
    views, pictures, dropped = read_views(dataset, subject, expression, frame, config)
    alone = len(views) == 1 and not dropped  # a photograph, or a video of one camera
    if len(views) < config.min_views and not alone:
        why = "; ".join(f"{row['what']}: {row['why']}" for row in dropped)
        raise StageError(
            f"{item}: {len(views)} usable cameras, expected at least {config.min_views} with a"
            f" matte of the head ({why or 'no others are calibrated'}); run 'express50 matte'"
        )
    surface, used = make_surface(dataset, item, views, config)
    extent = float(np.ptp(surface.vertices[np.unique(surface.faces)], axis=0).max())
    if not UNITS[0] < extent < UNITS[1]:
        raise StageError(
            f"{item}: the surface is {extent:.3g} m large, expected {UNITS[0]} to {UNITS[1]} m;"
            " is the calibration in metres?"
        )
    write_ply(out / "surface.ply", surface)
    if config.glb:
        write_glb(out / "surface.glb", surface)
    seen, photo = look(surface, pictures, config)
    for name, view in seen.items():
        write_maps(out, name, view, config)
    write_picture(out, pictures, seen, photo, config.qc_views)
    numbers = surface.numbers | {"extent_m": extent}
    return metrics(numbers, seen, photo) | used | {"dropped": dropped}


def make_surface(
    dataset: Dataset, item: str, views: list[View], config: DepthConfig
) -> tuple[Surface, dict]:
    """The surface, and for the metrics what it was made from beside the views."""
    subject, expression = item.split("/")
    if len(views) == 1:  # a photograph, or a video of one camera
        prior, track = read_prior(dataset, subject, expression, views, config)
        if prior is None:
            raise StageError(
                f"{item}: one camera, so that its depth is the tracked head's, which does not"
                f" count: {track['why']}; run 'express50 track' and look at its overlays"
            )
        surface = tracked_surface(views[0], config, prior)
        return surface, {"track": track}
    prior, track = read_prior(dataset, subject, expression, views, config)
    return reconstruct(views, config, prior), {"track": track}


def look(
    surface: Surface, pictures: Pictures, config: DepthConfig
) -> tuple[dict[str, DepthView], dict[str, Agreement]]:
    """What every camera sees of the surface, and what its neighbours say of that, by camera."""
    scene = mesh_scene(surface.vertices, surface.faces)
    photo = agreements([make_shot(scene, *row, config.consistency_side) for row in pictures])
    seen = {}
    for (camera, _, alpha), agreement in zip(pictures, photo, strict=True):
        view = cast_view(surface, scene, camera, alpha)
        seen[camera.id] = vouched(view, agreement)
    return seen, dict(zip(seen, photo, strict=True))


def read_views(
    dataset: Dataset, subject: str, expression: str, frame: int, config: DepthConfig
) -> tuple[list[View], Pictures, list[dict]]:
    """Usable views, their full-size (camera, frame, alpha), and the cameras dropped."""
    views: list[View] = []
    pictures: Pictures = []
    reasons = {}
    for camera_id, camera in read_cameras_of(dataset, subject).items():
        try:
            rgb, alpha = _read_pair(dataset, subject, camera_id, expression, frame)
        except (CaptureError, FormatError, StageError) as error:
            reasons[camera_id] = str(error)
            continue
        view = make_view(camera, rgb, alpha, config.image_side)
        if isinstance(view, str):
            reasons[camera_id] = view
            continue
        views.append(view)
        pictures.append((camera, rgb, alpha))
    views, contradicted = without_contradiction(views)
    pictures = [row for row in pictures if row[0].id not in contradicted]
    dropped = [{"what": name, "why": why} for name, why in sorted((reasons | contradicted).items())]
    return views, pictures, dropped


def _read_pair(
    dataset: Dataset, subject: str, camera_id: str, expression: str, frame: int
) -> tuple[np.ndarray, np.ndarray]:
    """Undistorted frame (H, W, 3) uint8 and alpha (H, W) float32."""
    path = dataset.matte_file(subject, expression, camera_id)
    if not path.is_file():
        raise StageError("it has no matte")
    alpha = read_alpha(path).astype(np.float32) / 255
    return read_frame(dataset, subject, camera_id, frame), alpha


def read_prior(
    dataset: Dataset, subject: str, expression: str, views: list[View], config: DepthConfig
) -> tuple[Prior | None, dict]:
    """The tracked mesh as a prior, or None, and what was made of it for the metrics."""
    path = dataset.item_dir("track", subject) / "track.npz"
    if not config.use_track or not path.is_file():
        return None, {"used": False, "why": "there is none" if config.use_track else "use_track"}
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
    if agreement < config.track_agreement:
        why = f"only {agreement:.0%} of it lies in the mattes, under {config.track_agreement:.0%}"
        return None, {"used": False, "why": why, "agreement": agreement}
    return make_prior(vertices, faces), {"used": True, "agreement": agreement}


STAGE = Stage(
    name="depth",
    version=7,
    config=DepthConfig,
    presets=PRESETS,
    items=peak_items,
    inputs=inputs,
    run=run,
)
