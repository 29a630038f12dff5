"""Numbers and the picture by which people judge a reconstruction."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from express50.files.images import contact_sheet, write_image
from express50.geometry.cameras import Camera
from pipelines.depth.consistency import Agreement
from pipelines.depth.raycast import DepthView

ERROR_STEPS = 30.0  # 8-bit steps at the bright end of the error maps
BLANK = 24  # grey of what is not known

Pictures = list[tuple[Camera, np.ndarray, np.ndarray]]


def metrics(numbers: dict, seen: dict[str, DepthView], photo: dict[str, Agreement]) -> dict:
    """Numbers of the item, rounded so that they do not hang on the last bit."""
    errors = np.concatenate([one.errors[np.isfinite(one.errors)] for one in photo.values()])
    compared = float(np.mean([one.compared for one in photo.values()]))
    table = numbers | {
        "coverage": float(np.mean([view.covered for view in seen.values()])),
        "coverage_worst": min(view.covered for view in seen.values()),
        "spill": float(np.mean([view.spill for view in seen.values()])),
        "confidence_mean": float(
            np.mean([v.confidence[v.valid].mean() for v in seen.values() if v.valid.any()])
        ),
        "voxel_share": numbers["voxels_allocated"] / numbers["voxels_dense"],
        "views": len(seen),
    }
    table |= Agreement(errors, compared).numbers()
    cameras = {name: _of_camera(view, photo[name]) for name, view in seen.items()}
    return {k: round(v, 5) if isinstance(v, float) else v for k, v in table.items()} | {
        "cameras": cameras
    }


def _of_camera(view: DepthView, photo: Agreement) -> dict[str, float]:
    sure = float(view.confidence[view.valid].mean()) if view.valid.any() else 0.0
    table = {"coverage": view.covered, "spill": view.spill, "confidence": sure}
    return {key: round(value, 4) for key, value in (table | photo.numbers()).items()}


def write_picture(
    out: Path,
    pictures: Pictures,
    seen: dict[str, DepthView],
    photo: dict[str, Agreement],
    count: int,
) -> None:
    """Contact sheet of evenly chosen cameras: frame, depth, normals, confidence, photo error."""
    chosen = np.unique(np.linspace(0, len(pictures) - 1, max(1, count)).round().astype(int))
    rows: list[list[np.ndarray]] = [[], [], [], [], []]
    for camera, rgb, _ in (pictures[k] for k in chosen):
        view = seen[camera.id]
        rows[0].append(rgb)
        rows[1].append(_depth_picture(view))
        normal = (view.normals * [1, -1, -1] + 1) * 127.5
        rows[2].append(np.where(view.valid[..., None], normal, BLANK).astype(np.uint8))
        rows[3].append((view.confidence * 255).astype(np.uint8))
        rows[4].append(_error_picture(photo[camera.id]))
    labels = ["frame", "depth", "normals", "confidence", f"photo error, 0 to {ERROR_STEPS:g}/255"]
    (out / "qc").mkdir(exist_ok=True)
    sheet = contact_sheet(rows, labels, tile=(240, 240))
    write_image(out / "qc" / "surface.jpg", sheet, quality=90)


def _depth_picture(view: DepthView) -> np.ndarray:
    """Depth as a colour picture (H, W, 3) uint8, near is bright."""
    if not view.valid.any():
        return np.full((*view.depth.shape, 3), BLANK, np.uint8)
    low, high = np.percentile(view.depth[view.valid], [1, 99])
    near = np.clip((high - view.depth) / max(high - low, 1e-6), 0, 1)
    color = cv2.applyColorMap((near * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)[..., ::-1]
    return np.where(view.valid[..., None], color, BLANK).astype(np.uint8)


def _error_picture(photo: Agreement) -> np.ndarray:
    """Photometric errors as a colour picture (H, W, 3) uint8, large is bright."""
    known = np.isfinite(photo.errors)
    share = np.clip(np.where(known, photo.errors, 0) / ERROR_STEPS, 0, 1)
    color = cv2.applyColorMap((share * 255).astype(np.uint8), cv2.COLORMAP_INFERNO)[..., ::-1]
    return np.where(known[..., None], color, BLANK).astype(np.uint8)
