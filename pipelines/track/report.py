"""Show whether a track is right: overlays, a sheet and residuals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import cv2
import numpy as np
import torch

from express50.capture.frames import read_cameras_of, read_peak_frame
from express50.contract.layout import Dataset
from express50.files.images import write_image
from express50.geometry.cameras import Camera, pinhole_camera, project_pinhole
from express50.geometry.conventions import affine_to_opencv
from express50.geometry.pixels import ALARM, tile_sheet
from express50.geometry.raycast import camera_rays, mesh_scene
from express50.geometry.transforms import transform_points
from express50.head.model import HeadModel, landmarks, landmarks_of
from pipelines.track.observe import facing
from pipelines.track.outline import OutlineTerm
from pipelines.track.state import Target
from pipelines.track.terms import PixelTerm

TILE = 384
SHEET_TILE, COLUMNS = 192, 8
BAR = 18  # height of a camera's row, pixels
ODD = 1.5  # times the median: such residuals are drawn in ALARM
PLAIN, GROUND, DIM = (225, 225, 225), 24, (110, 160, 210)
ResidualTable = Mapping[str, Mapping[str, float]]
SEEN_COLOR, FITTED_COLOR = (255, 210, 0), (0, 255, 120)


def draw_overlays(
    dataset: Dataset,
    subject: str,
    folder: Path,
    model: HeadModel,
    targets: list[Target],
    vertices: np.ndarray,
    rotations: np.ndarray,
) -> dict[str, np.ndarray]:
    """Write overlay_<expression>.jpg: frame above, mesh and landmarks below, in four views.

    Landmarks are yellow as detected and green as fitted, the mesh's outline is red. Vertices
    (E, V, 3) world, rotations (E, 3, 3) from head to it.
    Returns by expression the overlay (TILE, TILE, 3) uint8 in the view that the face looks at.
    """
    folder.mkdir(parents=True, exist_ok=True)
    cameras = read_cameras_of(dataset, subject)
    frontal = {}
    for target, mesh, rotation in zip(targets, vertices, rotations, strict=True):
        views = sorted(
            target.observation.views, key=lambda view: -facing(view, rotation, mesh.mean(0))
        )
        pool, columns = [view.camera_id for view in views], {}
        chosen = [pool.pop(0)]
        while pool and len(chosen) < 4:  # then the furthest from those chosen
            axes = np.stack([cameras[name].cam_from_world[2, :3] for name in chosen])
            far = [float((axes @ cameras[name].cam_from_world[2, :3]).max()) for name in pool]
            chosen.append(pool.pop(int(np.argmin(far))))
        for camera_id in sorted(chosen):
            frame = read_peak_frame(dataset, subject, target.observation.expression, camera_id)
            seen = [v.points for v in target.observation.views if v.camera_id == camera_id]
            columns[camera_id] = draw_column(frame, cameras[camera_id], model, mesh, seen)
        path = folder / f"overlay_{target.observation.expression}.jpg"
        write_image(path, np.concatenate(list(columns.values()), axis=1), quality=88)
        frontal[target.observation.expression] = columns[chosen[0]][TILE:]
    return frontal


def draw_column(
    frame: np.ndarray,
    camera: Camera,
    model: HeadModel,
    mesh: np.ndarray,
    seen: list[np.ndarray],
    tile: int = TILE,
) -> np.ndarray:
    """Draw frame and overlay (2 tile, tile, 3) of the part of one view where the head is.

    The frame (H, W, 3) uint8 is undistorted; the pinhole camera's id is written on the picture.
    `mesh` (V, 3) is of the world; `seen` are arrays (N, 2) of detected pixels.
    """
    pixels, _ = project_pinhole(camera, mesh)
    low, high = pixels.min(0), pixels.max(0)
    side = 1.08 * float((high - low).max())
    corner = 0.5 * (low + high) - 0.5 * side
    scale = tile / side
    matrix = np.array([[scale, 0, -scale * corner[0]], [0, scale, -scale * corner[1]]])
    flags = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    crop = cv2.warpAffine(frame, affine_to_opencv(matrix), (tile, tile), flags=flags)
    # Visible edges of triangles and the mesh's outline are blended into the crop.
    K = np.diag([scale, scale, 1.0]) @ camera.K
    K[:2, 2] += matrix[:, 2]
    view = pinhole_camera(camera.id, K, crop.shape[1], crop.shape[0], camera.cam_from_world)
    cast = mesh_scene(mesh, model.faces.numpy()).cast_rays(camera_rays(view))
    hit = np.isfinite(cast["t_hit"].numpy())
    bary = cast["primitive_uvs"].numpy()
    smallest = np.minimum(bary.min(2), 1 - bary.sum(2))
    edge = hit & (smallest < 0.08)
    rim = hit ^ cv2.erode(hit.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    image = crop.astype(np.float32)
    image[edge] = 0.7 * image[edge] + 0.3 * np.array([90, 200, 255], np.float32)
    image[rim] = np.array([255, 60, 60], np.float32)
    shaded = np.ascontiguousarray(image.astype(np.uint8))
    marks = landmarks_of(model, mesh)
    _dots(shaded, transform_points(matrix, project_pinhole(camera, marks)[0]), FITTED_COLOR)
    for points in seen:
        _dots(shaded, transform_points(matrix, points), SEEN_COLOR)
    cv2.putText(shaded, camera.id, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1)
    return np.concatenate([crop, shaded])


def _dots(image: np.ndarray, points: np.ndarray, color: tuple[int, int, int]) -> None:
    """Draw small dots at tile pixels (N, 2), corner origin, in place."""
    for x, y in points:
        if 0 <= x < image.shape[1] and 0 <= y < image.shape[0]:
            cv2.circle(image, (int(x), int(y)), 1, color, -1, cv2.LINE_AA)


def write_sheet(folder: Path, tiles: Mapping[str, np.ndarray], table: ResidualTable) -> None:
    """Write sheet.jpg: one overlay per expression and one bar per camera.

    The tiles are those of `draw_overlays`; the table maps expressions to cameras to the RMS of
    their landmarks, pixels (`landmark_rms_px`).
    """
    folder.mkdir(parents=True, exist_ok=True)
    parts = [expression_sheet(tiles, expression_residuals(table)), camera_bars(table)]
    width = max(part.shape[1] for part in parts)
    padded = [
        np.pad(part, ((0, 0), (0, width - part.shape[1]), (0, 0)), constant_values=GROUND)
        for part in parts
    ]
    write_image(folder / "sheet.jpg", np.concatenate(padded), quality=90)


def expression_residuals(table: ResidualTable) -> dict[str, float]:
    """Return RMS pixels per expression that has landmarks, its cameras weighted equally."""
    return {name: _rms(row.values()) for name, row in table.items() if row}


def camera_residuals(table: ResidualTable) -> dict[str, tuple[float, int]]:
    """Return RMS pixels per camera and its number of expressions, sorted by id."""
    found: dict[str, list[float]] = {}
    for row in table.values():
        for camera, value in row.items():
            found.setdefault(camera, []).append(value)
    return {camera: (_rms(found[camera]), len(found[camera])) for camera in sorted(found)}


def expression_sheet(tiles: Mapping[str, np.ndarray], residuals: Mapping[str, float]) -> np.ndarray:
    """Draw expressions (H, W, 3) uint8 as tiles, each with its residual in pixels and its name.

    Residuals far above the median stand out.
    """
    limit = ODD * float(np.median(list(residuals.values()))) if residuals else math.inf
    labels = {
        name: f"{residuals[name]:.2f} px  {name}" if name in residuals else f"{name}: no landmarks"
        for name in tiles
    }
    odd = [label for name, label in labels.items() if residuals.get(name, 0.0) > limit]
    columns = min(COLUMNS, max(1, math.ceil(math.sqrt(1.6 * len(tiles)))))
    pictures = {labels[name]: image for name, image in tiles.items()}
    return tile_sheet(pictures, columns, SHEET_TILE, odd)


def camera_bars(table: ResidualTable) -> np.ndarray:
    """Draw a bar chart (H, W, 3) uint8: RMS pixels per camera, with its number of expressions."""
    rows = camera_residuals(table)
    values = [value for value, _ in rows.values()]
    limit = ODD * float(np.median(values)) if values else math.inf
    widths = [cv2.getTextSize(name, cv2.FONT_HERSHEY_SIMPLEX, 0.4, 1)[0][0] for name in rows]
    left, length = 16 + max(widths, default=0), 2 * SHEET_TILE
    chart = np.full((BAR * (len(rows) + 1) + 8, left + length + 190, 3), GROUND, np.uint8)
    title = "landmark residual by camera, RMS px" if rows else "no camera has landmarks"
    _write(chart, title, 6, 14, PLAIN)
    scale = length / max([*values, 1e-9])
    for k, (camera, (value, count)) in enumerate(rows.items(), 1):
        y = BAR * k
        odd = value > limit
        _write(chart, camera, 6, y + 14, ALARM if odd else PLAIN)
        end = left + max(1, round(value * scale))
        cv2.rectangle(chart, (left, y + 4), (end, y + 14), ALARM if odd else DIM, -1)
        label = f"{value:.2f}  ({count} expression{'s' if count > 1 else ''})"
        _write(chart, label, end + 6, y + 14, PLAIN)
    return chart


def _write(image: np.ndarray, text: str, x: int, y: int, colour: tuple[int, int, int]) -> None:
    """Write a text with its baseline at (x, y)."""
    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)


def _rms(values: Iterable[float]) -> float:
    return float(np.sqrt(np.mean(np.square(list(values)))))


def track_metrics(model: HeadModel, targets: list[Target], vertices: np.ndarray) -> dict:
    """Measure the reprojection of inlier landmarks, RMS pixels per expression and camera."""
    marks = landmarks(model, torch.from_numpy(vertices)).numpy()
    table: dict[str, dict[str, float]] = {}
    used, total = 0, 0
    for target, points in zip(targets, marks, strict=True):
        row = {}
        for view, inliers in zip(target.observation.views, target.observation.inliers, strict=True):
            pixels, _ = project_pinhole(view.camera, points)
            squared = ((pixels - view.points) ** 2).sum(1)
            chosen = inliers.copy()
            chosen[:17] = False
            if chosen.any():
                row[view.camera_id] = round(float(np.sqrt(squared[chosen].mean())), 4)
            used, total = used + int(inliers.sum()), total + inliers.size
        table[target.observation.expression] = row
    values = [value for row in table.values() for value in row.values()]
    terms = [target.terms for target in targets]
    marked = 0  # views whose irises or visible jaw line were fitted
    for own in terms:
        seen = [one for term in own if isinstance(term, PixelTerm) for one in term.sightings]
        marked += len({sighting.camera.id for sighting in seen if len(sighting.rows)})
    return {
        "expressions": len(targets),
        "landmark_rms_px": table,
        "landmark_rms_px_mean": round(float(np.mean(values)), 4) if values else None,
        "landmarks_used": used,
        "landmarks_seen": total,
        "outline_views": sum(isinstance(term, OutlineTerm) for own in terms for term in own),
        "marked_views": marked,
        "head": model.name,
    }


def error_figures(
    sigma: np.ndarray,
    vertices: np.ndarray,
    cameras: Mapping[str, Camera],
    marks_px: Mapping[str, float],
    outline_views: int,
) -> dict[str, np.ndarray | float]:
    """Describe how well the vertices (V, 3) of an expression are known, for `error_bounds`.

    `sigma` (V,) are metres; `marks_px` is the landmarks' RMS per camera.
    """
    away = [np.linalg.norm(c.center - vertices.mean(0)) / c.K[0, 0] for c in cameras.values()]
    pixel = 1e3 * float(np.median(away))
    return {
        "sigma_mm": 1e3 * sigma,
        "landmark_mm": pixel * _rms(marks_px.values()) if marks_px else math.inf,
        "pixel_mm": pixel,
        "views": float(max(len(marks_px), 1)),
        "outline_views": 1.0 + outline_views,
    }
