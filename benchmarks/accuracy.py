"""Measure a dataset against the twin's truth, which is opened here, after the stages have run.

A rig solved from a board has a world of its own. One rigid motion per subject, fitted to the
cameras, takes it to the true world; what is left of the calibration error stays in every figure.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from benchmarks.calibrate import figures as rig_figures
from benchmarks.depth_score import cast
from benchmarks.regions_truth import iou_figures, true_head_alpha, true_labels, view_row
from benchmarks.truth import Truth, align_worlds
from express50.capture.expressions import NEUTRAL
from express50.capture.frames import read_cameras_of, read_recorded_cameras
from express50.capture.index import read_peaks
from express50.contract.layout import Dataset
from express50.contract.segmentation_labels import COLOURS
from express50.dataset.depth_files import depth_file, read_depth, read_normals
from express50.dataset.tracks import read_track
from express50.errors import Express50Error
from express50.files.images import read_image, write_image
from express50.geometry.cameras import Camera, pinhole, transform_camera
from express50.geometry.pixels import contact_sheet
from express50.geometry.transforms import transform_points

VIEWS_PER_PEAK = 2  # views measured of every peak; they walk around the rig from peak to peak
VIEWS_PER_SUBJECT = 8  # at least: a rig's first cameras may all look at the back of the head
SHEET_ROWS = 7
ERROR_RANGE_MM = 8.0  # full colour in the error pictures
ERROR_RANGE_DEG = 45.0  # white in those of normals


def measure_dataset(dataset: Dataset, truth_root: Path, out: Path | None = None) -> dict:
    """Return all figures that the published stages allow; write error pictures below ``out``."""
    truth = Truth(truth_root)
    measures = {
        "calibrate": measure_calibrate,
        "align": measure_align,
        "matte": measure_matte,
        "track": measure_track,
        "depth": measure_depth,
        "regions": measure_regions,
    }
    figures: dict[str, float | int | None] = {}
    for stage, measure in measures.items():
        if dataset.stage_dir(stage).is_dir():
            figures |= {f"{stage}.{k}": v for k, v in measure(dataset, truth, out).items()}
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "accuracy.json").write_text(json.dumps(figures, indent=1) + "\n")
    return figures


def measure_calibrate(dataset: Dataset, truth: Truth, out: Path | None = None) -> dict:
    """Return the worst rotation, position and head-place error of the cameras over all subjects."""
    rows = [
        rig_figures(read_recorded_cameras(dataset, subject), truth.cameras(subject))
        for subject in calibrated_subjects(dataset)
    ]
    keys = ("rotation_error_deg_max", "translation_error_mm_max", "head_px")
    if not rows:
        return {"rigs": 0}
    return {key: float(np.max([row[key] for row in rows])) for key in keys}


def calibrated_subjects(dataset: Dataset) -> list[str]:
    """Return the subjects whose cameras were published."""
    return [s for s in dataset.subjects() if dataset.item_dir("calibrate", s).is_dir()]


def measure_align(dataset: Dataset, truth: Truth, out: Path | None = None) -> dict:
    """Return frames between each label and the true peak; the neutral expression has none."""
    errors = [
        abs(frame - truth.peaks(subject)[expression])
        for subject in dataset.subjects()
        for expression, frame in read_peaks(dataset, subject).items()
        if expression != NEUTRAL
    ]
    if not errors:
        return {"labels": 0}
    return {
        "peak_error_frames_median": float(np.median(errors)),
        "peak_error_frames_mean": round(float(np.mean(errors)), 3),
        "within_1_frame": round(float(np.mean(np.array(errors) <= 1)), 3),
        "labels": len(errors),
    }


def true_world_cameras(dataset: Dataset, truth: Truth, subject: str) -> dict[str, Camera]:
    """Return the estimated pinhole cameras of the recorded size, moved into the true world.

    Maps that stages made of reduced pictures are enlarged to it.
    """
    recorded = read_recorded_cameras(dataset, subject)
    motion = align_worlds(recorded, truth.cameras(subject))
    return {c: transform_camera(pinhole(camera), motion) for c, camera in recorded.items()}


def sampled_views(dataset: Dataset, truth: Truth) -> Iterator[tuple[str, str, int, Camera]]:
    """Yield (subject, expression, frame, camera in the true world), a few of every peak."""
    turn = 0
    for subject in dataset.subjects():
        cameras = list(true_world_cameras(dataset, truth, subject).values())
        walk = [camera for start in range(3) for camera in cameras[start::3]]
        peaks = read_peaks(dataset, subject)
        views = max(VIEWS_PER_PEAK, math.ceil(VIEWS_PER_SUBJECT / max(1, len(peaks))))
        for expression, frame in peaks.items():
            for _ in range(min(views, len(walk))):
                yield subject, expression, frame, walk[turn % len(walk)]
                turn += 1


def enlarged(image: np.ndarray, camera: Camera, how: int = cv2.INTER_LINEAR) -> np.ndarray:
    """Return an image (h, w[, C]) at a camera's size."""
    size = camera.width, camera.height
    return image if image.shape[1::-1] == size else cv2.resize(image, size, interpolation=how)


def enlarged_depth(
    depth: np.ndarray, valid: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth and validity (H, W) at a camera's size, valid where every neighbour is."""
    return enlarged(depth, camera), enlarged(valid.astype(np.float32), camera) == 1


def measure_matte(dataset: Dataset, truth: Truth, out: Path | None = None) -> dict:
    """Return the mean absolute alpha errors over whole images, and over the truth's soft rim."""
    whole, rim, rows, names = [], [], [], []
    for subject, expression, frame, camera in sampled_views(dataset, truth):
        path = dataset.matte_file(subject, expression, camera.id)
        if not path.is_file():
            continue
        alpha = enlarged(read_image(path), camera).astype(np.float64) / 255.0
        true = truth.render_alpha(subject, frame, camera)
        error = np.abs(alpha - true)
        soft = (true > 0.02) & (true < 0.98)
        whole.append(error.mean())
        if soft.any():
            rim.append(error[soft].mean())
        rows.append([_grey(alpha), _grey(true), _grey(error)])
        names.append(f"{subject} {expression} {camera.id}: alpha, truth, error")
    if not whole:
        return {"views": 0}
    _sheet(out, "matte_error", rows, names)
    return {
        "mae": float(np.mean(whole)),
        "mae_rim": float(np.mean(rim)) if rim else None,
        "views": len(whole),
    }


def measure_track(dataset: Dataset, truth: Truth, out: Path | None = None) -> dict:
    """Return the rms distance between tracked and true vertices of the same topology."""
    squares, medians = [], []
    for subject in dataset.subjects():
        path = dataset.track_file(subject)
        if not path.is_file():
            continue
        motion = align_worlds(read_cameras_of(dataset, subject), truth.cameras(subject))
        track = read_track(path)
        for vertices, frame in zip(track.vertices, track.frames, strict=True):
            moved = transform_points(motion, vertices)
            true = truth.vertices(subject, int(frame))
            if true.shape != moved.shape:
                raise Express50Error(
                    f"{subject}: tracked {moved.shape[0]} vertices, the truth has"
                    f" {true.shape[0]}; vertex errors need the twin's own head model"
                )
            distance = np.linalg.norm(moved - true, axis=1)
            squares.append(float((distance**2).mean()))
            medians.append(float(np.median(distance)))
    if not squares:
        return {"meshes": 0}
    return {
        "vertex_rmse_mm": 1e3 * float(np.sqrt(np.mean(squares))),
        "vertex_median_mm": 1e3 * float(np.median(medians)),
        "meshes": len(squares),
    }


def measure_depth(dataset: Dataset, truth: Truth, out: Path | None = None) -> dict:
    """Return absolute depth errors where both know the surface, and the share that is covered.

    Errors on skin are given apart, as the truth's hair is single strands, which no surface follows.
    """
    errors, skin, degrees, covered, rows, names = [], [], [], [], [], []
    for subject, expression, frame, camera in sampled_views(dataset, truth):
        folder = dataset.item_dir("depth", f"{subject}/{expression}")
        path = depth_file(folder, camera.id)
        if path is None:
            continue
        depth, valid = enlarged_depth(*read_depth(path), camera)
        true, true_valid = truth.render_depth(subject, frame, camera)
        both = valid & true_valid
        errors.append(1e3 * np.abs(depth - true)[both])
        bare = both & truth.skin(subject, frame, camera)
        skin.append(1e3 * np.abs(depth - true)[bare])
        turned = _normal_error(folder / f"{camera.id}_normals.png", truth, subject, frame, camera)
        degrees.append(turned[bare & np.isfinite(turned)])
        covered.append(both.sum() / max(1, true_valid.sum()))
        rows.append(
            [
                _depth_grey(depth, valid),
                _depth_grey(true, true_valid),
                _heat(depth - true, both),
                _grey(np.where(bare, np.nan_to_num(turned) / ERROR_RANGE_DEG, 0.0)),
            ]
        )
        names.append(
            f"{subject} {expression} {camera.id}: depth, truth, error to {ERROR_RANGE_MM:g} mm,"
            f" normals on skin to {ERROR_RANGE_DEG:g} degrees"
        )
    if not errors:
        return {"views": 0}
    _sheet(out, "depth_error", rows, names)
    every, bare, turns = map(np.concatenate, (errors, skin, degrees))
    return {
        "abs_error_mm_median": float(np.median(every)) if len(every) else None,
        "abs_error_mm_p95": float(np.percentile(every, 95)) if len(every) else None,
        "skin_error_mm_median": float(np.median(bare)) if len(bare) else None,
        "normal_error_deg_median": float(np.median(turns)) if len(turns) else None,
        "coverage": float(np.mean(covered)),
        "views": len(errors),
    }


def _normal_error(path: Path, truth: Truth, subject: str, frame: int, camera: Camera) -> np.ndarray:
    """Return angles (H, W), degrees, of a normal map to the true head's; NaN where unknown."""
    if not path.is_file():
        return np.full((camera.height, camera.width), np.nan)
    found, known = read_normals(path)
    found = enlarged(found, camera)
    known = enlarged(known.astype(np.float32), camera) == 1
    head = truth.vertices(subject, frame), truth.head_model(subject).faces.numpy()
    depth, normals = cast(head, camera)
    cosine = np.clip((found * normals).sum(-1), -1, 1)
    return np.where(known & np.isfinite(depth), np.degrees(np.arccos(cosine)), np.nan)


def measure_regions(dataset: Dataset, truth: Truth, out: Path | None = None) -> dict:
    """Return the mean absolute error of the head's alpha, and the parts' mean IoU."""
    found, rows, names = [], [], []
    for subject, expression, frame, camera in sampled_views(dataset, truth):
        folder = dataset.item_dir("regions", f"{subject}/{expression}")
        if not (folder / f"{camera.id}.png").is_file():
            continue
        labels = enlarged(read_image(folder / f"{camera.id}.png"), camera, cv2.INTER_NEAREST)
        alpha = enlarged(read_image(folder / f"{camera.id}_head.png"), camera) / 255.0
        true = true_labels(truth, subject, frame, camera)
        true_alpha = true_head_alpha(truth, subject, frame, camera)
        found.append(view_row(true, true_alpha, alpha, labels))
        rows.append([COLOURS[labels], COLOURS[true], _grey(np.abs(alpha - true_alpha))])
        names.append(f"{subject} {expression} {camera.id}: parts, truth, error of the head's alpha")
    if not found:
        return {"views": 0}
    _sheet(out, "regions_error", rows, names)
    return {
        "head_mae": float(np.mean([row["mae"] for row in found])),
        "iou_mean": iou_figures(found)["iou_mean"],
        "views": len(found),
    }


def _grey(image: np.ndarray) -> np.ndarray:
    return np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)


def _depth_grey(depth: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the depth as grey, near is bright."""
    if not valid.any():
        return np.zeros(depth.shape, np.uint8)
    low, high = np.percentile(depth[valid], [1, 99])
    return _grey(np.where(valid, 1.0 - 0.8 * (depth - low) / max(1e-6, high - low), 0.0))


def _heat(error_m: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the signed error as colour: red in front of the truth, blue behind it."""
    e = np.where(known, error_m * 1e3 / ERROR_RANGE_MM, 0.0)
    colour = np.stack(
        [1 - np.clip(e, 0, 1), 1 - np.abs(np.clip(e, -1, 1)), 1 + np.clip(e, -1, 0)], -1
    )
    return _grey(np.where(known[..., None], colour, 0.1))


def _sheet(out: Path | None, name: str, rows: list, names: list[str]) -> None:
    if out is None or not rows:
        return
    out.mkdir(parents=True, exist_ok=True)
    # an odd step meets every camera of an even rig
    chosen = range(0, len(rows), max(1, len(rows) // SHEET_ROWS) | 1)
    sheet = contact_sheet([rows[k] for k in chosen], [names[k] for k in chosen], tile=(240, 240))
    write_image(out / f"{name}.jpg", sheet, quality=88)
