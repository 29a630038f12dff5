"""Depth against the twin's truth, beside two baselines: ``python -m benchmarks.depth --help``.

Every item is reconstructed anew three ways from the same mattes, frames and calibrated cameras:
``depth`` (the stage), ``visual_hull`` (mattes alone) and ``tracked_mesh`` (the track alone, where
there is one). Times are process CPU seconds of one thread. The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d

from express50.cameras import rays, transform_camera
from express50.config import resolve_config
from express50.frames import read_peaks
from express50.head.load import load_head
from express50.layout import Dataset
from express50.raycast import mesh_scene
from express50.tracks import read_track
from express50.twin.truth import Truth, align_worlds
from pipelines.depth import STAGE
from pipelines.depth.grid import Grid, head_box, hull_distance
from pipelines.depth.reconstruct import reconstruct
from pipelines.depth.stage import Pictures, read_prior, read_views
from pipelines.depth.surface import closed, extract_mesh


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dataset", type=Path, default=Path("build/demo/data/demo"))
    parser.add_argument("--truth", type=Path, default=Path("build/demo/twin/truth"))
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--set", dest="assignments", action="append", default=[])
    parser.add_argument("--items", type=int, default=0, help="only this many; 0: all")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    if not Dataset(args.dataset).stage_dir("matte").is_dir():
        sys.exit(f"{args.dataset}: no mattes; run 'make demo' or name --dataset and --truth")
    dataset, truth = Dataset(args.dataset), Truth(args.truth)
    config = resolve_config(STAGE, args.preset, None, args.assignments)
    rows: dict[str, list[dict]] = {"depth": [], "visual_hull": [], "tracked_mesh": []}
    for item in STAGE.items(dataset)[: args.items or None]:
        for name, row in measure_item(dataset, truth, item, config).items():
            rows[name].append(row)
            print(item, name, {k: v for k, v in summary([row]).items() if v is not None})
    result = summary(rows.pop("depth"))
    result["baselines"] = {name: summary(found) for name, found in rows.items() if found}
    print(json.dumps({"benchmark": "depth", "preset": args.preset, **result}))
    return 0


def measure_item(dataset: Dataset, truth: Truth, item: str, config: object) -> dict[str, dict]:
    """Errors, coverage and seconds of each way on one item."""
    subject, expression = item.split("/")
    frame = read_peaks(dataset, subject)[expression]
    views, pictures, _ = read_views(dataset, subject, expression, frame, config)
    cameras = {camera.id: camera for camera, _, _ in pictures}
    motion = align_worlds(cameras, truth.cameras(subject))
    true = {
        name: truth.render_depth(subject, frame, transform_camera(camera, motion))
        for name, camera in cameras.items()
    }
    start = time.process_time()
    prior, _ = read_prior(dataset, subject, expression, views, config)
    surface = reconstruct(views, config, prior)
    seconds = time.process_time() - start
    found = {"depth": compare(surface.vertices, surface.faces, pictures, true) | {"s": seconds}}
    start = time.process_time()
    low, high = head_box(views)
    shape = np.ceil((high - low) / 0.003).astype(int) + 1
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    hull = Grid(low, 0.003, closed(hull_distance(views, low + 0.003 * index).reshape(shape)))
    vertices, _, faces = extract_mesh(hull)
    seconds = time.process_time() - start
    found["visual_hull"] = compare(vertices, faces, pictures, true) | {"s": seconds}
    path = dataset.item_dir("track", subject) / "track.npz"
    if path.is_file():
        track = read_track(path)
        if expression in track.expressions:
            mesh = track.vertices[track.row(expression)].astype(np.float64)
            head = load_head(track.head).faces.numpy()
            found["tracked_mesh"] = compare(mesh, head, pictures, true)
            both = np.isfinite(found["tracked_mesh"]["errors"])
            there = np.where(both, found["depth"]["errors"], np.nan)
            found["tracked_mesh"]["depth_there"] = there
    return found


def compare(
    vertices: np.ndarray, faces: np.ndarray, pictures: Pictures, true: dict[str, tuple]
) -> dict:
    """Absolute errors (N,), millimetres, of a mesh at every pixel of every view, and its coverage.

    Errors are NaN where the mesh or the truth has no surface or the matte is transparent.
    """
    scene = mesh_scene(vertices, faces)
    errors, covered = [], []
    for camera, _, alpha in pictures:
        origin, directions = rays(camera)
        row = np.concatenate([np.broadcast_to(origin, directions.shape), directions], -1)
        hits = scene.cast_rays(o3d.core.Tensor(row.astype(np.float32)), nthreads=1)
        depth = hits["t_hit"].numpy()
        true_depth, true_valid = true[camera.id]
        both = np.isfinite(depth) & (alpha > 0.5) & true_valid
        errors.append(
            np.where(both, 1e3 * np.abs(np.where(both, depth, 0) - true_depth), np.nan).ravel()
        )
        covered.append(both.sum() / max(1, true_valid.sum()))
    return {"errors": np.concatenate(errors), "covered": float(np.mean(covered))}


def summary(rows: list[dict]) -> dict:
    """Median and p95 over all pixels, mean coverage, mean seconds an item."""
    errors = np.concatenate([row["errors"] for row in rows])
    seconds = [row["s"] for row in rows if "s" in row]
    there = [row["depth_there"] for row in rows if "depth_there" in row]
    figures = {
        "abs_error_mm_median": round(float(np.nanmedian(errors)), 3),
        "abs_error_mm_p95": round(float(np.nanpercentile(errors, 95)), 3),
        "coverage": round(float(np.mean([row["covered"] for row in rows])), 4),
        "seconds_per_frame": round(float(np.mean(seconds)), 2) if seconds else None,
        "items": len(rows),
    }
    if there:  # the stage at the pixels that the tracked mesh covers: the fair comparison
        figures["depth_there_mm_median"] = round(float(np.nanmedian(np.concatenate(there))), 3)
    return figures


if __name__ == "__main__":
    raise SystemExit(main())
