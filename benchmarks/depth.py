"""Measure depth against the twin's ground truth: every preset beside three baselines.

``python -m benchmarks.depth [--dataset DIR --truth DIR]``; without a dataset the digital twin
records a subject with 24 cameras at 512 pixels (two more are recorded and unused) and the stages
before depth are run. Baselines see the same mattes, frames and cameras: ``visual_hull`` (mattes
alone), ``tracked_mesh`` (the track alone) and ``tsdf_fusion`` (plane sweeps fused by Open3D).
Errors are over all pixels that the matte, the truth and the surface share; ``skin`` counts those
where the truth shows the head's own surface, because true depth jumps from strand to strand in
hair. Normals are compared there. ``abs_error_mm_p95_of_surest`` is over the given shares of the
pixels, the most confident ones: it falls if confidence is honest. Seconds are processor seconds of
one thread, peak memory that of a process of its own. ``--sweep`` varies one setting at a time
instead and writes a table. The last line is one JSON object.
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
from express50.capture.index import read_peaks
from express50.contract.config import build_config
from express50.contract.layout import Dataset
from express50.dataset.tracks import read_track
from express50.head.load import load_head
from express50.runner.worker import peak_memory
from express50.twin.truth import Truth
from pipelines import track
from pipelines.depth import STAGE
from pipelines.depth.blocks import build
from pipelines.depth.maps import surface_maps
from pipelines.depth.reconstruct import reconstruct
from pipelines.depth.stage import read_tracked, read_views
from pipelines.depth.surface import extract_mesh
from pipelines.depth.views import DepthView, head_box, hull_distance

PRESETS = ("draft", "standard", "reference")
BASELINES = ("visual_hull", "tracked_mesh", "tsdf_fusion")
BASELINE_VOXEL_M = 0.003


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
        solid, _ = read_tracked(dataset, item, views)
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
        maps = surface_maps(surface, pictures)
        sure = {name: view.whole(view.confidence) for name, view, _ in maps}
    return found | score(mesh, truth, subject, frame, pictures, sure)


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


if __name__ == "__main__":
    raise SystemExit(main())
