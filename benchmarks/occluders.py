"""Measure what glasses, hands and hair on the face cost: ``python -m benchmarks.occluders``.

The twin records one person bare and with each of the things, and the stages up to ``regions`` are
run with their defaults; `off` runs ``track``, ``depth`` and ``regions`` without what they do about
things in front of the face, on the same mattes.

``iou`` is that of the label of what hides the face (apparel, hand, hair) against the truth, over
the pixels at which the face of the bare head mesh would be seen. A lens is apparel; where hair
truly hides the face, hair alone is asked for. The ratios say what a thing costs, with it over
without: ``face_error_ratio`` of the rms vertex error of the face, hidden or not;
``depth_error_ratio`` and ``depth_coverage_ratio`` of the mean error and the known share of the
face's skin that is truly seen. ``together`` pools the kinds. Seconds are processor seconds of the
three stages per expression. ``--quick`` takes smaller footage and leaves `off` out. The last line
is one JSON object.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from benchmarks.accuracy import true_world_cameras
from benchmarks.common import make_parser, rms, run_or_stop
from benchmarks.regions_truth import true_labels
from benchmarks.track import prepare, twin_config
from benchmarks.track_views import face_of
from benchmarks.truth import Truth, align_worlds
from express50.capture.frames import read_cameras_of
from express50.capture.index import read_peaks
from express50.contract.layout import Dataset
from express50.contract.segmentation_labels import label_mask
from express50.dataset.depth_files import depth_file, read_depth
from express50.dataset.tracks import read_track
from express50.files.images import read_image
from express50.geometry.raycast import visible_faces
from express50.geometry.transforms import transform_points
from express50.twin import TwinConfig
from pipelines import depth, regions, track

KINDS = {"glasses": ("glasses",), "hand": ("hand",), "beard": ("beard", "moustache"),
         "fringe": ("fringe",)}  # fmt: skip
FURTHER = {"microphone": ("microphone",), "mask": ("mask",)}
LABEL = {"glasses": "apparel", "microphone": "apparel", "mask": "apparel", "hand": "hand"}
STAGES = (track.STAGE, depth.STAGE, regions.STAGE)
# What is replaced for `off`.
OFF: dict[str, object] = {
    "pipelines.track.schedule.under_hair": lambda model, *_: np.zeros(len(model.template), bool),
    "pipelines.track.schedule.find_things": lambda *_: np.zeros((0, 3)),
    "pipelines.track.schedule.find_worn_glasses": lambda *_: np.zeros((0, 3)),
    "pipelines.depth.stage.face_views": lambda *_: [],
    "pipelines.regions.stage.find_hands": lambda _, labels, __: np.zeros(labels.shape, bool),
    "pipelines.regions.colour.bare_skin": lambda _, skin, *__: skin,
}
Row = dict[str, float]


def main(arguments: list[str] | None = None) -> int:
    """Record, run the stages, and print the figures."""
    parser = make_parser("occluders", __doc__)
    parser.add_argument("--recording", type=Path, default=Path("build/bench-occluders"))
    parser.add_argument("--subject", type=int, default=71, help="of the twin")
    parser.add_argument("--cameras", type=int, default=14, help="of these 2 are left out")
    parser.add_argument("--side", type=int, default=448, help="pixels of the recorded footage")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=[*KINDS, *FURTHER])
    parser.add_argument("--ways", nargs="+", default=["off", "on"], choices=["off", "on"])
    parser.add_argument("--quick", action="store_true", help="320 px, 10 cameras, on alone")
    options = parser.parse_args(arguments)
    if options.quick:
        options.cameras, options.side, options.ways = 12, 320, ["on"]
    twin = twin_config(1, options.cameras, options.side)
    twin = replace(
        twin, first_subject=options.subject, expressions=("neutral", "smile", "jaw_open")
    )
    result: dict = {"benchmark": "occluders"}
    kinds = {"none": ()} | {name: (KINDS | FURTHER)[name] for name in options.kinds}
    for way in options.ways:
        rows = {}
        for name, worn in kinds.items():
            folder = f"{options.subject}-{options.cameras}x{options.side}"
            source = recorded(replace(twin, wear=worn), options.recording / folder / name)
            rows[name] = measured(*source, way, LABEL.get(name, "hair"))
            print(way, name, summary([rows[name]], [rows["none"]]), file=sys.stderr, flush=True)
        bare = rows.pop("none")
        figures = {name: summary([row], [bare]) for name, row in rows.items()}
        figures["together"] = summary(list(rows.values()), [bare] * len(rows))
        result[way] = figures
    result |= result.get("on", result[options.ways[0]])["together"]
    print(json.dumps(result))
    return 0


def recorded(config: TwinConfig, folder: Path) -> tuple[Dataset, Truth]:
    """Return a recording with mattes, made where it is not there."""
    if not (folder / "done").is_file():
        prepare(config, folder)
        (folder / "done").touch()
    return Dataset(folder / "dataset"), Truth(folder / "truth")


def measured(dataset: Dataset, truth: Truth, way: str, label: str) -> Row:
    """Run the stages on a copy of a dataset and sum its figures over expressions and views."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        own = Dataset(Path(folder) / "data")
        own.root.mkdir()
        for path in dataset.root.iterdir():
            (own.root / path.name).symlink_to(path.resolve())
        for stage in STAGES:
            (own.root / stage.name).unlink(missing_ok=True)
        for target, other in OFF.items() if way == "off" else ():
            stack.enter_context(patch(target, other))
        began = time.process_time()
        for stage in STAGES:
            run_or_stop(stage, own)
        seconds = time.process_time() - began
        return figures_of(own, truth, seconds, label)


def figures_of(dataset: Dataset, truth: Truth, seconds: float, label: str) -> Row:
    """Compare labels, mesh and depth maps of the one subject with the truth."""
    (subject,) = dataset.subjects()
    tracked = read_track(dataset.track_file(subject))
    cameras = true_world_cameras(dataset, truth, subject)
    model = truth.head_model(subject)
    motion = align_worlds(read_cameras_of(dataset, subject), truth.cameras(subject))
    faces, on_face = model.faces.numpy(), face_of(model)
    both = either = seen = known = 0
    mesh_errors, depth_errors = [], []
    for expression, frame in read_peaks(dataset, subject).items():
        true = truth.vertices(subject, frame)
        moved = transform_points(motion, tracked.vertices[tracked.row(expression)])
        mesh_errors.append(np.linalg.norm(moved - true, axis=1)[on_face])
        item = f"{subject}/{expression}"
        for name, camera in cameras.items():
            first, _ = visible_faces(true, faces, camera)
            face = (first >= 0) & on_face[faces[first]].all(-1)
            labels = read_image(dataset.item_dir("regions", item) / f"{name}.png")
            kinds = true_labels(truth, subject, frame, camera)
            asked = face & ~label_mask(kinds, "hair") if label != "hair" else face
            found, hidden = (label_mask(part, label) & asked for part in (labels, kinds))
            both, either = both + (found & hidden).sum(), either + (found | hidden).sum()
            path = depth_file(dataset.item_dir("depth", item), name)
            if path is None:
                sys.exit(f"{dataset.root}: {item}/{name} has no depth")
            z, valid = read_depth(path)
            skin = truth.skin(subject, frame, camera) & face
            true_z, _ = truth.render_depth(subject, frame, camera)
            depth_errors.append(1e3 * np.abs(z - true_z)[skin & valid])
            seen, known = seen + skin.sum(), known + (skin & valid).sum()
    return {
        "mesh": 1e3 * rms(np.concatenate(mesh_errors)),
        "both": both, "either": either, "seen": seen, "known": known,
        "depth": float(np.concatenate(depth_errors).mean()),
        "seconds": seconds / len(mesh_errors),
    }  # fmt: skip


def summary(rows: list[Row], bare: list[Row]) -> dict[str, float | None]:
    """Compare rows with what the bare person gives."""

    def ratio(value: float) -> float:
        return round(float(value), 4)

    def pooled(name: str, some: list[Row]) -> float:
        return rms(np.array([row[name] for row in some]))

    def coverage(some: list[Row]) -> float:
        return float(sum(row["known"] for row in some) / sum(row["seen"] for row in some))

    either = sum(row["either"] for row in rows)
    return {
        "iou": ratio(sum(row["both"] for row in rows) / either) if either else None,
        "face_error_ratio": ratio(pooled("mesh", rows) / pooled("mesh", bare)),
        "face_error_mm": ratio(pooled("mesh", rows)),
        "depth_coverage_ratio": ratio(coverage(rows) / coverage(bare)),
        "depth_error_ratio": ratio(pooled("depth", rows) / pooled("depth", bare)),
        "depth_error_mm": ratio(pooled("depth", rows)),
        "seconds_per_expression": round(float(np.mean([row["seconds"] for row in rows])), 1),
    }


if __name__ == "__main__":
    raise SystemExit(main())
