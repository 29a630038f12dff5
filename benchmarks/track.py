"""Measure tracked heads against the truth, with landmarks alone and a rigid template beside them.

``python -m benchmarks.track [--dataset DIR --truth DIR [--captures DIR]]``; without a dataset the
digital twin records subjects that the landmark detector was not trained on, two cameras are held
out of the capture, and the stages up to mattes are run. Peaks are the true ones, so that the
figures speak of tracking alone. `landmark_only` is `standard` without outlines, patches and
UV landmarks. Seconds are processor seconds of the stage, reading and overlays included; those of
`clip` are all that the clip takes beyond the peaks, per camera's view of a frame.
The last line printed is one JSON object; `benchmarks.track_truth` defines its figures, and
`benchmarks.track_views` the held-out cameras' picture.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from benchmarks.common import (
    add_twin_options,
    check_twin_options,
    keep_cameras,
    make_parser,
    run_or_stop,
    write_peaks,
)
from benchmarks.track_truth import Errors, clip_errors, compare, mean, pooled, summary
from benchmarks.track_views import held_out_views
from benchmarks.truth import Truth
from express50.capture.frames import read_cameras_of
from express50.capture.index import index_to_json, read_index, read_peaks
from express50.contract.config import build_config
from express50.contract.layout import Dataset
from express50.files.calibration import read_cameras, write_cameras
from express50.head.load import load_head
from express50.twin import TwinConfig
from express50.twin.record import record
from pipelines import calibrate, frames, ingest, matte
from pipelines.ingest import add_captures
from pipelines.track import STAGE
from pipelines.track import run as track_subject
from pipelines.track import stage as track_stage

EXPRESSIONS = ("neutral", "smile", "jaw_open", "pucker", "brow_raise", "wink_left")
PRESETS = ("draft", "standard")
LANDMARK_ONLY: dict[str, object] = {
    "outline_rounds": 0, "patch_rounds": 0, "uv_rounds": 0,
}  # fmt: skip
NO_CLIP = {
    "jitter_mm": None,
    "clip_face_rmse_mm": None,
    "jitter_reason": "--no-clip was given",
    "clip": None,
}
HELD_OUT = 2
SCALING_VIEWS, SCALING_SIDES = (4, 8, 16), (256, 512)
Reference = tuple[Dataset, Truth, Path | None]  # what was recorded; the whole captures, if at hand


def main(arguments: list[str] | None = None) -> int:
    """Track with every preset and print the errors."""
    options = parse(arguments)
    with tempfile.TemporaryDirectory() as scratch:
        if options.dataset is not None:
            source = Dataset(options.dataset), Truth(options.truth), options.captures
        else:
            config = twin_config(options.subjects, options.cameras, options.side, options.frames)
            source = prepare(config, Path(scratch) / "twin")
        result = benchmark(source, options.presets, options.subjects, options.clip)
        result["scaling"] = scaling(Path(scratch)) if options.scaling else None
    print(json.dumps(result))
    return 0


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """Return the command line."""
    parser = make_parser("track", __doc__)
    add_twin_options(parser)
    parser.add_argument("--captures", type=Path, help="its captures, with the held-out cameras")
    parser.add_argument("--presets", nargs="*", default=PRESETS, choices=PRESETS)
    parser.add_argument("--subjects", type=int, default=2)
    parser.add_argument("--cameras", type=int, default=18, help=f"of these {HELD_OUT} are held out")
    parser.add_argument("--side", type=int, default=512, help="pixels of the recorded footage")
    parser.add_argument("--clip", action=argparse.BooleanOptionalAction, default=True,
                        help="track one clip for its cost and errors")  # fmt: skip
    parser.add_argument("--frames", type=int, default=4, help="of a recorded clip")
    parser.add_argument("--scaling", action="store_true", help="also over views and pixels")
    options = parser.parse_args(arguments)
    check_twin_options(parser, options)
    if options.captures is not None and options.dataset is None:
        parser.error("--captures goes with --dataset and --truth")
    least = {"subjects": 1, "cameras": HELD_OUT + 2, "side": 64, "frames": 4}
    for name, count in least.items():
        if getattr(options, name) < count:
            parser.error(f"--{name} is {getattr(options, name)}, expected {count} or more")
    return options


def twin_config(subjects: int, cameras: int, side: int, frames: int = 4) -> TwinConfig:
    """Return subjects other than the demo's and the detector's; `frames` of every expression."""
    return TwinConfig(
        subjects=subjects, first_subject=41, cameras=cameras, width=side, height=side,
        expressions=EXPRESSIONS, frames_per_expression=frames, board_frames=0,
        give_calibration=True, footage="jpg", seed=5,
    )  # fmt: skip


def prepare(config: TwinConfig, folder: Path) -> Reference:
    """Record, hold cameras out, and run the stages that come before tracking."""
    record(config, folder, workers=1)
    seen = folder / "seen"
    for capture in sorted((folder / "captures").iterdir()):
        hold_out(capture, seen / capture.name)
    dataset, truth = Dataset(folder / "dataset"), Truth(folder / "truth")
    add_captures(dataset, sorted(seen.iterdir()))
    for stage in (ingest.STAGE, calibrate.STAGE):
        run_or_stop(stage, dataset)
    for subject in dataset.subjects():
        write_peaks(dataset, subject, truth.peaks(subject))
    for stage in (frames.STAGE, matte.STAGE):
        run_or_stop(stage, dataset)
    return dataset, truth, folder / "captures"


def hold_out(capture: Path, out: Path) -> None:
    """Copy the capture without HELD_OUT cameras, spread over the rig's inside."""
    names = sorted(path.name for path in (capture / "cameras").iterdir())
    held = [names[len(names) * (k + 1) // (HELD_OUT + 1) - k] for k in range(HELD_OUT)]
    shutil.copytree(capture, out, copy_function=os.link)
    keep_cameras(out, [name for name in names if name not in held])


def benchmark(source: Reference, presets: Sequence[str], count: int, clip: bool) -> dict:
    """Return figures of `landmark_only` and of the presets on the first `count` subjects."""
    dataset, truth, captures = source
    subjects = dataset.subjects()[:count]
    views = {s: held_out_views(dataset, truth, s, captures) for s in subjects}
    load_head(build_config(STAGE, {}).head)  # else the first preset alone would pay for it
    settings = {"landmark_only": LANDMARK_ONLY}
    settings |= {name: STAGE.presets.get(name, {}) for name in presets}
    result: dict = {
        "subjects": subjects,
        "cameras": len(read_cameras_of(dataset, subjects[0])),
        "held_out": sorted(
            {view.camera.id for rows in views[subjects[0]].values() for view in rows}
        ),
    }
    for name, values in settings.items():
        config = build_config(STAGE, values)
        rows: list[Errors] = []
        figures: list[dict] = []
        for subject in subjects:
            errors, found = track(dataset, truth, subject, config, views[subject])
            rows, figures = rows + errors, [*figures, found]
        result[name] = report(rows, figures, has_footage(views))
        result[name] |= track_clip(dataset, truth, subjects[0], config) if clip else NO_CLIP
        print(name, json.dumps(result[name]), file=sys.stderr, flush=True)
        result["baseline"] = {"vertex_rmse_mm": pooled([row.baseline for row in rows])}
        best = mean([value for row in rows for value in row.true_psnrs])
        result["true_mesh"] = {"heldout_camera_psnr_db": best}
    result["photometric_improves"] = None
    if "standard" in result:
        face = [result[name]["vertex_rmse_mm"]["face"] for name in ("standard", "landmark_only")]
        result["photometric_improves"] = bool(face[0] < face[1])
    return result


def has_footage(views: dict) -> bool:
    """Say whether any held-out camera has a picture."""
    return any(v.image is not None for rows in views.values() for row in rows.values() for v in row)


def track(
    dataset: Dataset,
    truth: Truth,
    subject: str,
    config,
    views: dict,  # noqa: ANN001
) -> tuple[list[Errors], dict]:
    """Return errors of a subject's frames, and what the stage itself says and costs."""
    with tempfile.TemporaryDirectory() as scratch:
        began = time.process_time()
        metrics = track_subject(dataset, subject, config, Path(scratch)).metrics
        seconds = time.process_time() - began
        errors = compare(dataset, truth, subject, Path(scratch) / "track.npz", views)
    return errors, {"seconds": seconds, "detected_px": metrics["landmark_rms_px_mean"]}


def report(rows: list[Errors], figures: list[dict], footage: bool) -> dict:
    """Return one preset's figures over all subjects."""
    result = summary(rows)
    detected = float(np.mean([row["detected_px"] for row in figures]))
    result["landmark_px"] = {"true": result.pop("landmark_px_true"), "detected": round(detected, 3)}
    seconds = sum(row["seconds"] for row in figures) / len(rows)
    result |= {"frames": len(rows), "seconds_per_frame": round(seconds, 3)}
    if result["heldout_camera_psnr_db"] is None:
        why = "no held-out camera shows enough of the face" if footage else (
            "no frames of held-out cameras; give --captures")  # fmt: skip
        result["heldout_camera_psnr_reason"] = why
    return result


def track_clip(dataset: Dataset, truth: Truth, subject: str, config) -> dict:  # noqa: ANN001
    """Return cost and errors of one expression's clip, with the shape of that and the neutral peak.

    A picture is one camera's view of one frame; the peaks' part of the run is not counted.
    """
    peaks = read_peaks(dataset, subject)
    cue = next(name for name in peaks if name != config.neutral)
    with tempfile.TemporaryDirectory() as scratch:
        part = narrowed(dataset, subject, Path(scratch) / "part", cues=(config.neutral, cue))
        out = Path(scratch) / "out"
        out.mkdir()
        seconds: list[float] = []
        with patch.object(track_stage, "write_clips", timed(track_stage.write_clips, seconds)):
            STAGE.run(part, subject, replace(config, frames="clips"), out)
        found = clip_errors(part, truth, subject, cue, out)
        (span,) = read_index(part, subject).cues
        frames = span.end_frame - span.start_frame + 1
        pictures = frames * len(read_cameras_of(part, subject))
        return found | {
            "clip": {
                "core_seconds_per_picture": round(seconds[0] / pictures, 4),
                "pictures": pictures,
                "face_rmse_mm": found["clip_face_rmse_mm"],
                "jitter_mm": found["jitter_mm"],
            }
        }


def timed(function: Callable, seconds: list[float]) -> Callable:
    """Return the function such that it appends the processor seconds of its calls."""

    def call(*values: object) -> object:
        began = time.process_time()
        try:
            return function(*values)
        finally:
            seconds.append(time.process_time() - began)

    return call


def narrowed(
    dataset: Dataset,
    subject: str,
    out: Path,
    cues: tuple[str, ...] | None = None,
    views: int | None = None,
) -> Dataset:
    """Link one subject's dataset: peaks of `cues` and the last one's clip, or fewer cameras."""
    part = Dataset(out)
    for stage in ("ingest", "calibrate", "align", "frames", "matte"):
        source = dataset.item_dir(stage, subject).resolve()
        part.item_dir(stage, subject).mkdir(parents=True)
        for path in source.iterdir():
            (part.item_dir(stage, subject) / path.name).symlink_to(path)
    part.captures_file.symlink_to(dataset.captures_file.resolve())
    if cues is not None:
        index = read_index(dataset, subject)
        index = replace(index, cues=tuple(c for c in index.cues if c.expression_id == cues[-1]))
        part.index_file(subject).unlink()
        part.index_file(subject).write_text(json.dumps(index_to_json(index)))
        part.peaks_file(subject).unlink()
        peaks = read_peaks(dataset, subject)
        write_peaks(part, subject, {name: peaks[name] for name in cues if name in peaks})
    if views is not None:
        file = part.cameras_file(subject)
        cameras = read_cameras(file)
        names = sorted(cameras)
        chosen = {names[round((len(names) - 1) * (k + 1) / (views + 1))] for k in range(views)}
        file.unlink()
        write_cameras(
            file, {k: v for k, v in cameras.items() if views >= len(names) or k in chosen}
        )
    return part


def scaling(scratch: Path) -> list[dict]:
    """Return seconds and face error of `standard` over views and pixels of a new subject."""
    config, rows = build_config(STAGE, {}), []
    for side in SCALING_SIDES:
        cameras = max(SCALING_VIEWS) + HELD_OUT
        dataset, truth, _ = prepare(twin_config(1, cameras, side), scratch / f"scaling_{side}")
        subject = dataset.subjects()[0]
        for views in SCALING_VIEWS:
            part = narrowed(dataset, subject, scratch / f"part_{side}_{views}", views=views)
            errors, found = track(part, truth, subject, config, {})
            face = pooled([row.distances for row in errors])["face"]
            seconds = round(found["seconds"] / len(errors), 3)
            rows.append({"views": views, "pixels": side, "seconds_per_frame": seconds,
                         "vertex_rmse_mm.face": face})  # fmt: skip
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    return rows


if __name__ == "__main__":
    sys.exit(main())
