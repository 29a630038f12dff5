"""The matte stage: one moment of one subject, the final 8-bit alpha of every camera."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np

from express50.capture.frames import (
    frame_inputs,
    read_cameras_of,
    read_peak_frame,
)
from express50.contract.layout import Dataset
from express50.errors import FormatError, StageError
from express50.files.images import contact_sheet, read_alpha, resize_area, write_image
from express50.geometry.cameras import Camera, pinhole, resized
from express50.geometry.conventions import undistorted_mask
from pipelines.matte.agreement import Agreement, agree
from pipelines.matte.config import MatteConfig
from pipelines.matte.hull import INSIDE, Ball, View, ball_of, center_of, projection_of

COLUMNS = 6  # of the picture
RED, GREEN = (235, 50, 40), (50, 220, 80)


def inputs(dataset: Dataset, item: str, config: MatteConfig) -> dict[str, Path | str]:
    """Cameras, and every camera's frame and alpha."""
    subject, expression = item.split("/")
    found: dict[str, Path | str] = {
        "cameras": dataset.item_dir("calibrate", subject) / "cameras.json",
        **frame_inputs(dataset, subject, expression),
    }
    for camera in read_cameras_of(dataset, subject):
        path = dataset.alpha_file(subject, expression, camera)
        if path.is_file():
            found[f"alpha {camera}"] = path
    return found


def run(dataset: Dataset, item: str, config: MatteConfig, out: Path) -> dict:
    """Write `<camera>.png` for every camera with an alpha, and a picture of what was changed."""
    cv2.setNumThreads(1)  # the runner counts one core an item
    subject, expression = item.split("/")
    cameras = read_cameras_of(dataset, subject, undistorted=False)
    files = {name: dataset.alpha_file(subject, expression, name) for name in cameras}
    there = {name: path for name, path in files.items() if path.is_file()}
    if not there:
        raise StageError(
            f"{item}: no camera has an alpha; see what 'express50 status {dataset.root}' says of"
            " the alpha stage, then run 'express50 matte' again"
        )
    views, found = _compared(dataset, item, {name: cameras[name] for name in there}, config)
    changes: dict[str, dict[str, float]] = {}
    for name, path in there.items():
        if name in found.removed or name in found.filled:
            before = read_alpha(path)
            after = corrected(before, found.removed.get(name), found.filled.get(name))
            write_image(out / f"{name}.png", after)
            changes[name] = _shares(before, after)
        else:
            shutil.copyfile(path, out / f"{name}.png")
    if views:
        _write_picture(out, views, found)
    return {
        "views": len(views),
        **({"unchanged": found.unchanged} if found.unchanged else {}),
        "removed": {name: row["removed"] for name, row in changes.items()},
        "filled": {name: row["filled"] for name, row in changes.items()},
        "warnings": found.warnings,
        "dropped": [
            {"what": name, "why": "it has no alpha"} for name in files if name not in there
        ],
    }


def _compared(
    dataset: Dataset, item: str, cameras: dict[str, Camera], config: MatteConfig
) -> tuple[list[View], Agreement]:
    """The reduced views, and what they agree on; no views where nothing is to be compared."""
    if not config.views:
        return [], Agreement(unchanged="matte.views is off")
    ball = ball_of(cameras)
    if ball is None:
        return [], Agreement(unchanged="the cameras do not look at one place")
    subject, expression = item.split("/")
    views = []
    # One camera's full pictures at a time.
    for name, camera in cameras.items():
        path = dataset.alpha_file(subject, expression, name)
        alpha = read_alpha(path)
        if alpha.shape != (camera.height, camera.width):
            raise FormatError(
                f"{path}: {alpha.shape[1]}x{alpha.shape[0]}, expected the camera's"
                f" {camera.width}x{camera.height}; run 'express50 matte {dataset.root}' again"
            )
        image = read_peak_frame(dataset, subject, expression, name)
        views.append(make_view(camera, ball, image, alpha, config.side))
    return views, agree(views, config)


def make_view(camera: Camera, ball: Ball, image: np.ndarray, alpha: np.ndarray, side: int) -> View:
    """A view of an undistorted image (H, W, 3) and alpha (H, W), uint8, of a recorded camera."""
    scale = min(1.0, side / max(camera.width, camera.height))
    width, height = (max(1, round(n * scale)) for n in (camera.width, camera.height))
    small = resized(camera, width, height)
    return View(
        name=camera.id,
        projection=projection_of(pinhole(small), ball),
        center=center_of(camera, ball),
        rgb=resize_area(image, width, height),
        alpha=resize_area(alpha, width, height).astype(np.float32) / 255,
        valid=undistorted_mask(small),
    )


def corrected(
    alpha: np.ndarray, removed: np.ndarray | None, filled: np.ndarray | None
) -> np.ndarray:
    """Alpha (H, W) uint8 less what is `removed` (h, w), with what is `filled`; soft at their edges.

    What neither reaches stays as it is to the bit.
    """
    size = (alpha.shape[1], alpha.shape[0])
    out = alpha.astype(np.float32)
    if removed is not None:
        out *= 1 - cv2.resize(removed.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    if filled is not None:
        weight = cv2.resize(filled.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        out = np.maximum(out, 255 * weight)
    return np.rint(out).astype(np.uint8)


def _shares(before: np.ndarray, after: np.ndarray) -> dict[str, float]:
    """Share of the image, by opacity, that was removed and filled."""
    change = after.astype(np.int64) - before
    share = {"removed": -change[change < 0].sum(), "filled": change[change > 0].sum()}
    return {key: round(float(value) / 255 / before.size, 6) for key, value in share.items()}


def _write_picture(out: Path, views: list[View], found: Agreement) -> None:
    """Every camera's subject, what was removed red and what was filled green."""
    odd = {warning["what"] for warning in found.warnings}
    tiles = []
    for view in views:
        tile = np.where(view.alpha[..., None] > INSIDE, view.rgb, view.rgb // 3)
        for masks, colour in ((found.removed, RED), (found.filled, GREEN)):
            if view.name in masks:
                mask = masks[view.name]
                tile[mask] = (0.3 * tile[mask] + 0.7 * np.array(colour)).astype(np.uint8)
        tiles.append(tile)
    rows = [tiles[k : k + COLUMNS] for k in range(0, len(tiles), COLUMNS)]
    names = [view.name + ("?" if view.name in odd else "") for view in views]
    labels = ["  ".join(names[k : k + COLUMNS]) for k in range(0, len(tiles), COLUMNS)]
    (out / "qc").mkdir()
    write_image(out / "qc" / "agreement.jpg", contact_sheet(rows, labels, (240, 240)), quality=88)
