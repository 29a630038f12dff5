"""The depth stage: one expression of one subject, a surface and a depth map for every camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from express50.cameras import Camera
from express50.errors import CaptureError, FormatError, StageError
from express50.frames import peak_items, read_cameras_of, read_frame, read_peaks
from express50.head.load import load_head
from express50.images import contact_sheet, read_alpha, write_depth_png, write_image
from express50.index import index_path
from express50.layout import Dataset
from express50.raycast import mesh_scene
from express50.stage import Stage
from express50.tracks import read_track
from pipelines.depth.config import PRESETS, DepthConfig
from pipelines.depth.grid import View
from pipelines.depth.prior import Prior, make_prior, matte_agreement
from pipelines.depth.raycast import DepthView, cast_view, write_ply
from pipelines.depth.reconstruct import reconstruct
from pipelines.depth.trace import trace_view
from pipelines.depth.views import make_view, without_contradiction

UNITS = (0.05, 1.0)  # metres; a head's box outside this range means other units than metres


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
    track = _track_path(dataset, subject)
    if config.use_track and track.is_file():
        found["track"] = track
    return found


def run(dataset: Dataset, item: str, config: DepthConfig, out: Path) -> dict:
    """Write a depth and a confidence map per camera, the coloured surface and a picture."""
    cv2.setNumThreads(1)  # the runner counts one core an item
    subject, expression = item.split("/")
    frame = read_peaks(dataset, subject)[expression]
    views, pictures, dropped = read_views(dataset, subject, expression, frame, config)
    if len(views) < config.min_views:
        why = "; ".join(f"{row['what']}: {row['why']}" for row in dropped)
        raise StageError(
            f"{item}: {len(views)} usable cameras, expected at least {config.min_views} with a"
            f" matte of the head ({why or 'no others are calibrated'}); run 'express50 matte'"
        )
    prior, track = read_prior(dataset, subject, expression, views, config)
    surface = reconstruct(views, config, prior)
    extent = float(np.ptp(surface.vertices[np.unique(surface.faces)], axis=0).max())
    if not UNITS[0] < extent < UNITS[1] * 3:
        raise StageError(
            f"{item}: the surface is {extent:.3g} m large, expected {UNITS[0]} to {UNITS[1] * 3} m;"
            " is the calibration in metres?"
        )
    scene = mesh_scene(surface.vertices, surface.faces)
    seen = {}
    for camera, _, alpha in pictures:
        if config.raycast == "sdf":
            seen[camera.id] = trace_view(surface, camera, alpha)
        else:
            seen[camera.id] = cast_view(surface, scene, camera, alpha)
        _write_view(out, camera.id, seen[camera.id])
    write_ply(out / "surface.ply", surface)
    _write_picture(out, pictures, seen, config.qc_views)
    return _metrics(surface.numbers, seen, track, extent, dropped)


def _track_path(dataset: Dataset, subject: str) -> Path:
    return dataset.item_dir("track", subject) / "track.npz"


Pictures = list[tuple[Camera, np.ndarray, np.ndarray]]


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
    path = _track_path(dataset, subject)
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


def _write_view(out: Path, camera_id: str, view: DepthView) -> None:
    write_depth_png(out / f"{camera_id}.png", view.depth, view.valid)
    write_image(
        out / f"{camera_id}_confidence.png", np.rint(view.confidence * 255).astype(np.uint8)
    )


def _metrics(
    numbers: dict, seen: dict[str, DepthView], track: dict, extent: float, dropped: list[dict]
) -> dict:
    """Numbers of the item, rounded so that they do not hang on the last bit."""
    table = numbers | {
        "extent_m": extent,
        "coverage": float(np.mean([view.covered for view in seen.values()])),
        "coverage_worst": min(view.covered for view in seen.values()),
        "spill": float(np.mean([view.spill for view in seen.values()])),
        "confidence_mean": float(
            np.mean([v.confidence[v.valid].mean() for v in seen.values() if v.valid.any()])
        ),
        "voxel_share": numbers["voxels_allocated"] / numbers["voxels_dense"],
        "views": len(seen),
    }
    rounded = {k: round(v, 5) if isinstance(v, float) else v for k, v in table.items()}
    track = {k: round(v, 4) if isinstance(v, float) else v for k, v in track.items()}
    cameras = {name: {"coverage": round(v.covered, 4), "spill": round(v.spill, 4),
                      "confidence": round(float(v.confidence[v.valid].mean()) if v.valid.any()
                                          else 0.0, 4)} for name, v in seen.items()}  # fmt: skip
    return rounded | {"track": track, "cameras": cameras, "dropped": dropped}


def _write_picture(out: Path, pictures: Pictures, seen: dict[str, DepthView], count: int) -> None:
    """Contact sheet: frame, depth, normals and confidence of evenly chosen cameras."""
    chosen = np.unique(np.linspace(0, len(pictures) - 1, max(1, count)).round().astype(int))
    rows: list[list[np.ndarray]] = [[], [], [], []]
    for camera, rgb, _ in (pictures[k] for k in chosen):
        view = seen[camera.id]
        rows[0].append(rgb)
        rows[1].append(_depth_picture(view))
        normal = (view.normals * [1, -1, -1] + 1) * 127.5
        rows[2].append(np.where(view.valid[..., None], normal, 24).astype(np.uint8))
        rows[3].append((view.confidence * 255).astype(np.uint8))
    labels = ["frame", "depth", "normals", "confidence"]
    (out / "qc").mkdir(exist_ok=True)
    sheet = contact_sheet(rows, labels, tile=(240, 240))
    write_image(out / "qc" / "surface.jpg", sheet, quality=90)


def _depth_picture(view: DepthView) -> np.ndarray:
    """Depth as a colour picture (H, W, 3) uint8, near is bright."""
    if not view.valid.any():
        return np.full((*view.depth.shape, 3), 24, np.uint8)
    low, high = np.percentile(view.depth[view.valid], [1, 99])
    near = np.clip((high - view.depth) / max(high - low, 1e-6), 0, 1)
    color = cv2.applyColorMap((near * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    return np.where(view.valid[..., None], color, 24).astype(np.uint8)


STAGE = Stage(
    name="depth",
    version=5,
    config=DepthConfig,
    presets=PRESETS,
    items=peak_items,
    inputs=inputs,
    run=run,
)
