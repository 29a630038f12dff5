"""Measure registered meshes against the twin's truth, with the tracked meshes beside them.

``python -m benchmarks.register``: the twin records subjects that nothing was tuned on, and the
stages up to ``register`` are run with their defaults. `standard` is registered on the surface of
``depth``, `scan` on the true surface of the head, `tracked` is not registered. `foreign` has the
same figures for a head of another model (``--foreign`` names one that the twin can play, such as an
ICT-FaceKit file) that the built-in head is tracked and registered on; ``n/a`` without one.

Point to surface is the distance of the face's vertices that two cameras see on the true head, to
the true head. Vertex errors need the same head model. `truth` counts the crossing triangles of the
twin's own mesh. `interval_90` is the share of these vertices
that lie within 1.645 of their stated standard deviations. Seconds are processor seconds of the
stage per expression. The last line printed is one JSON object.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import open3d as o3d

from benchmarks.common import make_parser, rms, run_or_stop
from benchmarks.track import EXPRESSIONS, prepare, twin_config
from benchmarks.track_views import face_of
from benchmarks.truth import Truth, align_worlds
from express50.capture.frames import read_cameras_of
from express50.contract.layout import Dataset
from express50.dataset.tracks import read_registration, read_track
from express50.geometry.cameras import pinhole
from express50.geometry.raycast import join_rays, mesh_scene
from express50.geometry.transforms import transform_points
from express50.head.load import load_head
from express50.head.model import HeadModel
from pipelines import depth, track
from pipelines.register import STAGE
from pipelines.register.lay import GivenSurface, lay, mesh_normals
from pipelines.register.untangle import crossings

SEEN_BY, SLANT, LIFT_M = 2, 0.3, 5e-4
SCAN_DETAIL_M = 0.003  # a true surface has no errors to smooth away
Figures = dict[str, float | None]


@dataclass(frozen=True)
class Case:
    """One expression: the tracked mesh (V, 3) in the true world, and its ground truth."""

    model: HeadModel
    mesh: np.ndarray
    true: tuple[np.ndarray, np.ndarray]
    seen: np.ndarray
    same: bool


def main(arguments: list[str] | None = None) -> int:
    """Record, run the stages, and print the errors."""
    parser = make_parser("register", __doc__)
    parser.add_argument("--subjects", type=int, default=2)
    parser.add_argument("--cameras", type=int, default=18, help="of these 2 are held out")
    parser.add_argument("--side", type=int, default=512, help="pixels of the recorded footage")
    parser.add_argument("--foreign", help="another head model for the twin")
    options = parser.parse_args(arguments)
    twin = twin_config(options.subjects, options.cameras, options.side)
    result: dict = {"benchmark": "register", "expressions": EXPRESSIONS}
    with tempfile.TemporaryDirectory() as scratch:
        own = prepare(twin, Path(scratch) / "own")[:2]
        result |= benchmark(*own)
        result["foreign"] = "n/a: --foreign names no head model"
        if options.foreign:
            other = replace(twin, head=options.foreign, subjects=1)
            result["foreign"] = benchmark(*prepare(other, Path(scratch) / "foreign")[:2])
    print(json.dumps(result))
    return 0


def benchmark(dataset: Dataset, truth: Truth) -> dict[str, Figures]:
    """Run the stages from track on and measure all expressions."""
    for stage in (track.STAGE, depth.STAGE, STAGE):
        began = time.process_time()
        run_or_stop(stage, dataset)
        seconds = time.process_time() - began
    rows: dict[str, list[Figures]] = {"tracked": [], "standard": [], "scan": []}
    true: list[float] = []
    for case, registered, sigma in cases(dataset, truth):
        scan = GivenSurface(*case.true, np.ones(len(case.true[0])))
        laid = lay(case.model, case.mesh, scan, SCAN_DETAIL_M)
        rows["tracked"].append(errors(case, case.mesh))
        rows["standard"].append(errors(case, registered, sigma))
        rows["scan"].append(errors(case, laid.vertices))
        true += [float(len(crossings(case.model, case.true[0])))] if case.same else []
    result = {name: pooled(found) for name, found in rows.items()}
    result["standard"]["seconds_per_frame"] = round(seconds / len(rows["standard"]), 2)
    result["truth"] = {"crossing_triangles": round(float(np.mean(true)), 3) if true else None}
    for name, figures in result.items():
        print(name, json.dumps(figures), file=sys.stderr, flush=True)
    return result


def cases(dataset: Dataset, truth: Truth) -> Iterator[tuple[Case, np.ndarray, np.ndarray]]:
    """Yield each expression with its registered mesh (V, 3), true world, and sigma (V,)."""
    for subject in dataset.subjects():
        found = read_track(dataset.track_file(subject))
        model = load_head(found.head)
        used = read_cameras_of(dataset, subject)
        motion = align_worlds(used, truth.cameras(subject))
        centres = [
            pinhole(camera).center
            for name, camera in truth.cameras(subject).items()
            if name in used
        ]
        for row, expression in enumerate(found.expressions):
            path = dataset.registration_file(subject, expression)
            if not path.is_file():
                continue
            registered = read_registration(path)
            mesh, laid = (
                transform_points(motion, vertices.astype(np.float64))
                for vertices in (found.vertices[row], registered.vertices)
            )
            frame = int(found.frames[row])
            head = truth.head_model(subject).faces.numpy()
            true = truth.vertices(subject, frame).astype(np.float64), head
            seen = face_of(model) & visible(mesh, model, true, truth.mesh(subject, frame), centres)
            same = len(true[0]) == len(mesh)
            yield Case(model, mesh, true, seen, same), laid, registered.sigma.astype(np.float64)


def visible(
    mesh: np.ndarray,
    model: HeadModel,
    true: tuple[np.ndarray, np.ndarray],
    scene: tuple[np.ndarray, np.ndarray],
    centres: list[np.ndarray],
) -> np.ndarray:
    """Mark vertices (V,) whose nearest point of the true head two cameras see, with nothing before.

    `scene` is all true geometry, hair included. Vertices that the mesh itself hides do not count.
    """
    middle = mesh.mean(0)
    casters = [mesh_scene(v - middle, f) for v, f in (scene, (mesh, model.faces.numpy()))]
    query = o3d.core.Tensor((mesh - middle).astype(np.float32))
    nearest = mesh_scene(true[0] - middle, true[1]).compute_closest_points(query)["points"].numpy()
    normals, count = mesh_normals(mesh, model.faces), np.zeros(len(mesh), int)
    for centre in centres:
        ray = centre - mesh
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        free = (ray * normals).sum(1) > SLANT
        for caster, start in zip(casters, (nearest, mesh - middle), strict=True):
            lifted = start + LIFT_M * (normals + ray)
            free &= ~caster.test_occlusions(join_rays(lifted, ray)).numpy()
        count += free
    return count >= SEEN_BY


def errors(case: Case, mesh: np.ndarray, sigma: np.ndarray | None = None) -> Figures:
    """Return errors of a mesh (V, 3) of a case, millimetres; None if they have no meaning."""
    middle = case.true[0].mean(0)
    caster = mesh_scene(case.true[0] - middle, case.true[1])
    query = o3d.core.Tensor((mesh[case.seen] - middle).astype(np.float32))
    distance = 1e3 * caster.compute_distance(query).numpy()
    regions = case.model.regions
    parts = {
        "face": face_of(case.model),
        "ears": (regions["left_ear"] | regions["right_ear"]).numpy(),
        "neck": regions["neck"].numpy(),
    }
    found: Figures = {
        "point_to_surface_mm.median": float(np.median(distance)),
        "point_to_surface_mm.p95": float(np.percentile(distance, 95)),
        "crossing_triangles": float(len(crossings(case.model, mesh))),
    }
    for name, part in parts.items():
        off = 1e3 * np.linalg.norm(mesh - case.true[0], axis=1)[part] if case.same else None
        found[f"vertex_rmse_mm.{name}"] = None if off is None else rms(off)
    if sigma is not None:
        found["interval_90"] = float(np.mean(distance < 1.645e3 * sigma[case.seen]))
    return found


def pooled(rows: list[Figures]) -> Figures:
    """Average figures over expressions: root mean squares of vertex errors, means of the others."""
    found: Figures = {}
    for name in rows[0] if rows else ():
        values = np.array([row[name] for row in rows if row[name] is not None], np.float64)
        average = rms(values) if name.startswith("vertex_rmse") and len(values) else None
        mean = float(values.mean()) if len(values) else None
        best = mean if average is None else average
        found[name] = None if best is None else round(best, 3)
    return found


if __name__ == "__main__":
    sys.exit(main())
