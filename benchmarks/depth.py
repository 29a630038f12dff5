"""Measure depth against the twin's ground truth: every preset beside three baselines.

``python -m benchmarks.depth [--dataset DIR --truth DIR]``; without a dataset the digital twin
records a subject with 24 cameras at 512 pixels (two more are recorded and unused) and the stages
before depth are run. Baselines see the same mattes, frames and cameras: ``visual_hull`` (mattes
alone), ``tracked_mesh`` (the track alone) and ``tsdf_fusion`` (plane sweeps fused by Open3D).
Errors are over all pixels that the matte, the truth and the surface share; ``skin`` counts those
where the truth shows the head's own surface, because true depth jumps from strand to strand in
hair. Normals are compared there. ``abs_error_mm_p95_of_surest`` is over the given shares of the
pixels, the most confident ones: it falls if confidence is honest. Seconds are processor seconds of
one thread, peak memory that of a process of its own. ``raycast`` compares rays cast at the mesh
with rays traced through the distances. ``--sweep`` varies one setting at a time instead and writes
a table. The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.common import (
    add_twin_options,
    check_twin_options,
    in_own_process,
    make_parser,
    run_or_stop,
)
from benchmarks.depth_fusion import sweep_and_fuse
from benchmarks.depth_score import Mesh, score, summary
from benchmarks.depth_sweep import AXES, sweep
from benchmarks.track import prepare, twin_config
from benchmarks.truth import Truth
from express50.capture.index import read_peaks
from express50.contract.config import build_config
from express50.contract.layout import Dataset
from express50.dataset.tracks import read_track
from express50.geometry.cameras import Camera, rays
from express50.geometry.raycast import camera_rays, mesh_scene
from express50.head.load import load_head
from express50.runner.worker import peak_memory
from pipelines import track
from pipelines.depth import STAGE
from pipelines.depth.blocks import LevelSet, build
from pipelines.depth.maps import surface_maps
from pipelines.depth.reconstruct import reconstruct
from pipelines.depth.stage import read_tracked, read_views
from pipelines.depth.surface import HeadSurface, extract_mesh
from pipelines.depth.views import DepthView, head_box, hull_distance

PRESETS = ("draft", "standard", "reference")
BASELINES = ("visual_hull", "tracked_mesh", "tsdf_fusion")
BASELINE_VOXEL_M = 0.003
RELAXATION = 0.8  # for `trace`; distances were moved and smoothed, so they are not exact
LEAST_STEP = 0.25  # voxels; rays along the surface still advance
MOST_STEPS, ROOT_STEPS = 400, 12


def main(arguments: list[str] | None = None) -> int:
    """Reconstruct with every preset and baseline and print the errors."""
    options = parse(arguments)
    with tempfile.TemporaryDirectory() as scratch:
        if options.dataset is None:
            options.dataset, options.truth = record(options, Path(scratch) / "twin")
        items = STAGE.items(Dataset(options.dataset))[: options.items or None]
        if options.sweep:
            print(json.dumps(sweep(options, items[0])))
            return 0
        result: dict = {"benchmark": "depth", "items": items}
        for name in (*options.presets, *BASELINES):
            rows = [
                in_own_process(measure, options.dataset, options.truth, item, name)
                for item in items
            ]
            result[name] = summary([row for row in rows if row])
            print(name, json.dumps(result[name]), file=sys.stderr, flush=True)
    medians = [result[name].get("abs_error_mm_median") for name in BASELINES if name in result]
    known = [value for value in medians if value is not None]
    if "standard" in result:
        best = result["standard"]["abs_error_mm_median"]
        result["standard_beats_baselines"] = all(best < value for value in known)
    print(json.dumps(result))
    return 0


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("depth", __doc__)
    add_twin_options(parser)
    parser.add_argument("--presets", nargs="*", default=PRESETS, choices=PRESETS)
    parser.add_argument("--items", type=int, default=0, help="only so many; 0: all")
    parser.add_argument("--cameras", type=int, default=26, help="recorded; two are not used")
    parser.add_argument("--side", type=int, default=512, help="pixels of the recorded footage")
    parser.add_argument("--sweep", action="store_true", help="one setting at a time, a table")
    parser.add_argument("--axes", nargs="+", default=AXES, choices=AXES, help="settings to sweep")
    parser.add_argument("--doc", type=Path, help="document whose section the sweep replaces")
    options = parser.parse_args(arguments)
    check_twin_options(parser, options)
    return options


def record(options: argparse.Namespace, folder: Path) -> tuple[Path, Path]:
    """Record one subject in two expressions and run the stages up to tracking."""
    twin = twin_config(1, options.cameras, options.side)
    twin = replace(twin, first_subject=43, expressions=("neutral", "smile"))
    dataset, truth, _ = prepare(twin, folder)
    run_or_stop(track.STAGE, dataset)
    return dataset.root, truth.root


def measure(dataset_root: Path, truth_root: Path, item: str, name: str) -> dict | None:
    """Measure errors, cost and coverage of a preset or baseline; None without a track."""
    cv2.setNumThreads(1)
    dataset, truth = Dataset(dataset_root), Truth(truth_root)
    subject, expression = item.split("/")
    frame = read_peaks(dataset, subject)[expression]
    config = build_config(STAGE, STAGE.presets.get(name, {}))
    views, pictures, _ = read_views(dataset, item, config.image_side)
    start = time.process_time()
    found: dict = {}
    if name in PRESETS:
        views, solid, _ = read_tracked(dataset, item, views)
        surface = reconstruct(views, solid, config.voxel_mm, config.voxel_px, config.noise)
        mesh = surface.vertices, surface.faces
        names = ("voxels_allocated", "voxels_dense", "grid_bytes", "voxel_mm")
        found |= {key: surface.figures[key] for key in names}
    else:
        found_mesh = baseline(name, dataset, subject, expression, views)
        if found_mesh is None:
            return None
        mesh = found_mesh
    found["s"] = None if name == "tracked_mesh" else time.process_time() - start
    found["gib"] = peak_memory() / 2**30
    sure = None
    if name in PRESETS:
        found["raycast"] = both_ways(surface, [picture.camera for picture in pictures[::8]])
        maps = surface_maps(surface, pictures)
        sure = {name: view.whole(view.confidence) for name, view, _ in maps}
    return found | score(mesh, truth, subject, frame, pictures, sure)


def both_ways(surface: HeadSurface, cameras: list[Camera]) -> dict:
    """Time rays cast at the mesh and traced through the distances, and compare the depths.

    Processor milliseconds per megapixel; building the mesh's tree counts, finding normals and
    confidence does not.
    """
    clock, depths = {}, {}
    pixels = sum(camera.width * camera.height for camera in cameras)
    for name in ("mesh", "sdf"):
        start = time.process_time()
        if name == "sdf":
            depths[name] = [trace(surface.grid, camera) for camera in cameras]
        else:
            scene = mesh_scene(surface.vertices, surface.faces)
            hits = [scene.cast_rays(camera_rays(camera), nthreads=1) for camera in cameras]
            depths[name] = [hit["t_hit"].numpy() for hit in hits]
        clock[name] = 1e9 * (time.process_time() - start) / pixels
    mesh, sdf = (np.concatenate([d.ravel() for d in depths[name]]) for name in ("mesh", "sdf"))
    both = np.isfinite(mesh) & np.isfinite(sdf)
    return {"ms": clock, "difference_mm": 1e3 * float(np.median(np.abs(mesh[both] - sdf[both])))}


def baseline(
    name: str, dataset: Dataset, subject: str, expression: str, views: list[DepthView]
) -> Mesh | None:
    """Make a baseline's surface."""
    if name == "tsdf_fusion":
        return sweep_and_fuse(views, BASELINE_VOXEL_M)
    if name == "visual_hull":
        box = head_box(views)
        grid = build(*box, BASELINE_VOXEL_M, lambda points: hull_distance(views, points))
        vertices, _, faces = extract_mesh(grid)
        return vertices, faces
    path = dataset.track_file(subject)
    found = read_track(path) if path.is_file() else None
    if found is None or expression not in found.expressions:
        return None
    vertices = found.vertices[found.row(expression)].astype(np.float64)
    return vertices, load_head(found.head).faces.numpy()


def trace(grid: LevelSet, camera: Camera) -> np.ndarray:
    """Find the first zero along every ray: depth (H, W), camera z in metres, infinite without one.

    A second opinion on rays cast at the mesh: no mesh comes between the grid and the depth. Steps
    are a share of the distance (Hart 1996) until the sign changes; the zero between the last two
    places is found by the Illinois variant of false position, which keeps it bracketed.
    """
    origin, directions = rays(camera)
    flat = directions.reshape(-1, 3)
    high = grid.origin + grid.voxel * (np.array(grid.shape) - 1)
    steep = np.where(np.abs(flat) > 1e-12, flat, 1e-12)
    ends = np.stack([(grid.origin - origin) / steep, (high - origin) / steep])
    near, far = np.maximum(ends.min(0).max(1), 1e-6), ends.max(0).min(1)  # in and out of the box
    depth = np.full(len(flat), np.inf)
    alive = np.flatnonzero(near < far)
    t, length = near[alive], np.linalg.norm(flat[alive], axis=1)
    before = t.copy()
    for _ in range(MOST_STEPS):
        value = grid.sample(origin + t[:, None] * flat[alive])
        inside = value < 0
        found = alive[inside]
        depth[found] = bracketed_root(grid, origin, flat[found], before[inside], t[inside])
        step = np.maximum(RELAXATION * value, LEAST_STEP * grid.voxel) / length
        onward = ~inside & (t + step < far[alive])
        if not onward.any():
            break
        before, t = t[onward], (t + step)[onward]
        alive, length = alive[onward], length[onward]
    return depth.reshape(directions.shape[:2]).astype(np.float32)


def bracketed_root(
    grid: LevelSet, origin: np.ndarray, directions: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Return depths (N,) of the zeros between depths outside (N,) and inside (N,)."""

    def value(t: np.ndarray) -> np.ndarray:
        return grid.sample(origin + t[:, None] * directions)

    above, below = value(low), value(high)
    t = high
    for _ in range(ROOT_STEPS):
        t = low + (high - low) * above / np.maximum(above - below, 1e-12)
        now = value(t)
        outside = now > 0
        # an end that stays twice would be approached from one side only: its weight is halved
        below, above = np.where(outside, below / 2, now), np.where(outside, now, above / 2)
        low, high = np.where(outside, t, low), np.where(outside, high, t)
    return t


if __name__ == "__main__":
    raise SystemExit(main())
