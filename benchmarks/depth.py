"""Depth against the twin's truth, every preset beside three baselines, in one run.

``python -m benchmarks.depth [--dataset DIR --truth DIR]``; without a dataset the digital twin
records a subject with 24 cameras at 512 pixels (two more are recorded and unused) and the stages
before depth are run. Baselines see the same mattes, frames and cameras: ``visual_hull`` (mattes
alone), ``tracked_mesh`` (the track alone) and ``tsdf_fusion`` (plane sweeps fused by Open3D).
Errors are over all pixels that the matte, the truth and the surface share; ``skin`` are those of
them where the truth shows the head's own surface, so that hair, whose true depth jumps from strand
to strand, can be told apart. Normals are compared there. A preset that refines by rendering has a
row ``<preset>_unrendered`` beside it, the same without. Seconds are processor seconds of one
thread, peak memory that of a process of its own. The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d

from benchmarks.depth_fusion import fuse
from benchmarks.track import prepare, twin_config
from express50.cameras import Camera, transform_camera
from express50.config import build_config
from express50.frames import read_peaks
from express50.head.load import load_head
from express50.layout import Dataset
from express50.raycast import camera_rays, mesh_scene
from express50.runner import run_stage
from express50.tracks import read_track
from express50.twin.truth import Truth, align_worlds
from pipelines import track
from pipelines.depth import STAGE
from pipelines.depth.grid import View, head_box
from pipelines.depth.reconstruct import Surface, hull_grid, reconstruct
from pipelines.depth.stage import read_prior, read_views
from pipelines.depth.surface import extract_mesh
from pipelines.depth.trace import trace

PRESETS = ("draft", "standard", "reference")
UNRENDERED = "_unrendered"  # a preset less its refinement by rendering
BASELINES = ("visual_hull", "tracked_mesh", "tsdf_fusion")
BASELINE_VOXEL_M = 0.003
BAND = ("band_voxels", "band_mib")  # what rendering keeps near the surface
Mesh = tuple[np.ndarray, np.ndarray]  # vertices (V, 3), faces (F, 3)


def main(arguments: list[str] | None = None) -> int:
    """Reconstruct with every preset and baseline and print the errors."""
    options = parse(arguments)
    with tempfile.TemporaryDirectory() as scratch:
        if options.dataset is None:
            options.dataset, options.truth = record(options, Path(scratch) / "twin")
        items = STAGE.items(Dataset(options.dataset))[: options.items or None]
        result: dict = {"benchmark": "depth", "items": items}
        for name in (*with_and_without(options.presets.split(",")), *BASELINES):
            rows = [alone(options.dataset, options.truth, item, name) for item in items]
            result[name] = summary([row for row in rows if row])
            print(name, json.dumps(result[name]), file=sys.stderr, flush=True)
    medians = [result[name].get("abs_error_mm_median") for name in BASELINES]
    known = [value for value in medians if value is not None]
    if "standard" in result:
        best = result["standard"]["abs_error_mm_median"]
        result["standard_beats_baselines"] = all(best < value for value in known)
    print(json.dumps(result))
    return 0


def with_and_without(presets: list[str]) -> list[str]:
    """The presets' names, each that renders followed by itself without rendering."""
    rendering = [name for name in presets if STAGE.presets[name].get("render_rounds")]
    return presets + [name + UNRENDERED for name in rendering]


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.depth", description=__doc__)
    parser.add_argument("--dataset", type=Path, help="dataset with mattes (and tracks)")
    parser.add_argument("--truth", type=Path, help="truth folder of the recording")
    parser.add_argument("--presets", default=",".join(PRESETS))
    parser.add_argument("--items", type=int, default=0, help="only so many; 0: all")
    parser.add_argument("--cameras", type=int, default=26, help="recorded; two are not used")
    parser.add_argument("--side", type=int, default=512, help="pixels of the recorded footage")
    options = parser.parse_args(arguments)
    if (options.dataset is None) != (options.truth is None):
        parser.error("give both --dataset and --truth, or neither")
    if not set(options.presets.split(",")) <= set(PRESETS):
        parser.error(f"--presets {options.presets!r}, expected some of {','.join(PRESETS)}")
    return options


def record(options: argparse.Namespace, folder: Path) -> tuple[Path, Path]:
    """Dataset, through tracking, and truth of one subject in two expressions."""
    twin = twin_config(1, options.cameras, options.side)
    twin = replace(twin, first_subject=43, expressions=("neutral", "smile"))
    dataset, truth, _ = prepare(twin, folder)
    run_stage(track.STAGE, dataset, build_config(track.STAGE, {}), workers=0, progress=False)
    return dataset.root, truth.root


def alone(dataset: Path, truth: Path, item: str, name: str) -> dict | None:
    """:func:`measure` in a process of its own, so that memory is its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(measure, dataset, truth, item, name).result()


def measure(dataset_root: Path, truth_root: Path, item: str, name: str) -> dict | None:
    """Errors, cost and coverage of one way on one item; None where there is no track."""
    cv2.setNumThreads(1)
    dataset, truth = Dataset(dataset_root), Truth(truth_root)
    subject, expression = item.split("/")
    frame = read_peaks(dataset, subject)[expression]
    preset = name.removesuffix(UNRENDERED)
    less = {} if preset == name else {"render_rounds": 0}
    config = build_config(STAGE, STAGE.presets.get(preset, {}) | less)
    views, pictures, _ = read_views(dataset, subject, expression, frame, config)
    start = time.process_time()
    found: dict = {}
    if preset in PRESETS:
        prior, _ = read_prior(dataset, subject, expression, views, config)
        surface = reconstruct(views, config, prior)
        mesh = surface.vertices, surface.faces
        shown = ("voxels", "voxel_mm", *BAND)
        found |= {key: surface.numbers[key] for key in shown if key in surface.numbers}
    else:
        made = baseline(name, dataset, subject, expression, views)
        if made is None:
            return None
        mesh = made
    found["s"] = None if name == "tracked_mesh" else time.process_time() - start
    found["gib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    if preset in PRESETS:
        found["raycast"] = both_ways(surface, [camera for camera, _, _ in pictures[::8]])
    cameras = {camera.id: camera for camera, _, _ in pictures}
    motion = align_worlds(cameras, truth.cameras(subject))
    rows = [
        compare(mesh, truth, subject, frame, camera, motion, alpha) for camera, _, alpha in pictures
    ]
    for key in ("errors", "skin", "degrees"):
        found[key] = np.concatenate([row[key] for row in rows])
    return found | {"covered": float(np.mean([row["covered"] for row in rows]))}


def both_ways(surface: Surface, cameras: list[Camera]) -> dict:
    """Processor milliseconds a megapixel of casting at the mesh and at the distances; difference.

    Building the mesh's tree counts, finding normals and confidence does not.
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
    name: str, dataset: Dataset, subject: str, expression: str, views: list[View]
) -> Mesh | None:
    """A baseline's surface."""
    if name == "tsdf_fusion":
        return fuse(views, BASELINE_VOXEL_M)
    if name == "visual_hull":
        grid = hull_grid(views, *head_box(views), BASELINE_VOXEL_M)
        vertices, _, faces = extract_mesh(grid)
        return vertices, faces
    path = dataset.item_dir("track", subject) / "track.npz"
    found = read_track(path) if path.is_file() else None
    if found is None or expression not in found.expressions:
        return None
    vertices = found.vertices[found.row(expression)].astype(np.float64)
    return vertices, load_head(found.head).faces.numpy()


def compare(
    mesh: Mesh, truth: Truth, subject: str, frame: int, camera: Camera, motion: np.ndarray,
    alpha: np.ndarray,
) -> dict:  # fmt: skip
    """One view: absolute errors (N,), millimetres, of all pixels and of skin; skin's normals."""
    seen = transform_camera(camera, motion)
    true_depth, true_valid = truth.render_depth(subject, frame, seen)
    depth, normals = cast(mesh, camera)
    both = np.isfinite(depth) & (alpha > 0.5) & true_valid
    errors = 1e3 * np.abs(np.where(both, depth, 0) - true_depth)
    skin = both & truth.skin(subject, frame, seen)
    head = truth.vertices(subject, frame), truth.head_model(subject).faces.numpy()
    _, true_normals = cast(head, seen)
    cosine = np.clip((normals * true_normals).sum(-1)[skin], -1, 1)
    return {
        "errors": errors[both],
        "skin": errors[skin],
        "degrees": np.degrees(np.arccos(cosine)),
        "covered": both.sum() / max(1, true_valid.sum()),
    }


def cast(mesh: Mesh, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W), infinite where nothing is hit, and smooth normals (H, W, 3), camera axes."""
    vertices, faces = mesh
    hull = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces)
    )
    hull.compute_vertex_normals()
    own = np.asarray(hull.vertex_normals)
    hits = mesh_scene(vertices, faces).cast_rays(camera_rays(camera), nthreads=1)
    depth = hits["t_hit"].numpy()
    hit = np.isfinite(depth)
    corners = faces[np.where(hit, hits["primitive_ids"].numpy(), 0)]
    u, v = np.moveaxis(hits["primitive_uvs"].numpy(), -1, 0)
    bary = np.stack([1 - u - v, u, v], axis=-1)
    normals = (own[corners] * bary[..., None]).sum(-2) @ camera.cam_from_world[:3, :3].T
    return depth, normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)


def summary(rows: list[dict]) -> dict:
    """Figures over the pixels of all items; ``n/a`` where nothing could be measured."""
    if not rows:
        return {"n/a": "these items have no track"}
    errors, skin, degrees = (
        np.concatenate([row[key] for row in rows]) for key in ("errors", "skin", "degrees")
    )
    if not len(errors) or not len(skin):
        return {"n/a": "no surface was found where the truth has one"}
    figures: dict = {
        "abs_error_mm_median": round(float(np.median(errors)), 3),
        "abs_error_mm_p95": round(float(np.percentile(errors, 95)), 3),
        "skin_error_mm_median": round(float(np.median(skin)), 3),
        "normal_error_deg_median": round(float(np.median(degrees)), 2),
        "coverage": round(float(np.mean([row["covered"] for row in rows])), 4),
        "peak_memory_gib": round(max(row["gib"] for row in rows), 2),
    }
    seconds = [row["s"] for row in rows if row["s"] is not None]
    figures["seconds_per_frame"] = round(float(np.mean(seconds)), 2) if seconds else None
    for key in BAND:
        if key in rows[0]:
            figures[key] = round(max(row[key] for row in rows), 1)
    if "voxels" in rows[0]:
        figures["voxel_mm"] = round(rows[0]["voxel_mm"], 3)
        # the grid is dense: as many are allocated as the box holds
        figures["voxels_allocated"] = max(row["voxels"] for row in rows)
        figures["voxels_dense"] = figures["voxels_allocated"]
        figures["raycast_ms_per_megapixel"] = {
            way: round(float(np.mean([row["raycast"]["ms"][way] for row in rows])), 1)
            for way in ("mesh", "sdf")
        }
        apart = [row["raycast"]["difference_mm"] for row in rows]
        figures["raycast_difference_mm"] = round(float(np.mean(apart)), 4)
    return figures


if __name__ == "__main__":
    raise SystemExit(main())
