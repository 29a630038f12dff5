"""How far tracked meshes are from the truth, and what a rigid template would give in the same run.

``python -m benchmarks.track [--dataset DIR --truth DIR]``; without a dataset a tiny one is recorded
with the digital twin (other subjects than the demo's) and brought up to mattes. Peaks are the true
ones, so that the figures speak of tracking alone. The last line printed is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from express50.config import build_config
from express50.frames import read_cameras_of
from express50.head.load import load_head
from express50.head.model import landmarks
from express50.index import read_index
from express50.layout import Dataset
from express50.runner import run_stage
from express50.transforms import rigid_fit
from express50.twin.config import TwinConfig
from express50.twin.record import record
from express50.twin.truth import Truth, align_worlds
from pipelines import alpha, calibrate, ingest, matte
from pipelines.ingest import register
from pipelines.track import STAGE

EXPRESSIONS = ("neutral", "smile", "jaw_open", "pucker", "brow_raise", "wink_left")


def main(arguments: list[str] | None = None) -> int:
    """Run the track stage at a preset and print its errors."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.track", description=__doc__)
    parser.add_argument("--dataset", type=Path, help="dataset with ingest, calibrate and mattes")
    parser.add_argument("--truth", type=Path, help="truth folder of the recording")
    parser.add_argument("--preset", default="standard", choices=sorted(STAGE.presets))
    parser.add_argument("--subjects", type=int, default=2)
    options = parser.parse_args(arguments)
    if (options.dataset is None) != (options.truth is None):
        parser.error("give both --dataset and --truth, or neither")
    with tempfile.TemporaryDirectory() as scratch:
        root = options.dataset or Path(scratch) / "dataset"
        truth = options.truth or record_tiny(Path(scratch), root, options.subjects)
        print(json.dumps(measure(Dataset(root), Truth(truth), options.preset)))
    return 0


def record_tiny(scratch: Path, root: Path, subjects: int) -> Path:
    """Record unseen subjects with given cameras and run the stages that come before tracking."""
    config = TwinConfig(
        subjects=subjects,
        first_subject=41,
        cameras=8,
        width=320,
        height=320,
        expressions=EXPRESSIONS,
        frames_per_expression=4,
        board_frames=0,
        give_calibration=True,
        footage="jpg",
        seed=5,
    )
    record(config, scratch / "twin", workers=1)
    dataset = Dataset(root)
    register(dataset, sorted((scratch / "twin" / "captures").iterdir()))
    for stage in (ingest.STAGE, calibrate.STAGE):
        run_stage(stage, dataset, build_config(stage, {}), workers=1, progress=False)
    write_true_peaks(dataset, Truth(scratch / "twin" / "truth"))
    for stage in (alpha.STAGE, matte.STAGE):
        run_stage(stage, dataset, build_config(stage, {}), workers=1, progress=False)
    return scratch / "twin" / "truth"


def write_true_peaks(dataset: Dataset, truth: Truth) -> None:
    """Publish the true peaks as labels."""
    for subject in dataset.subjects():
        index = read_index(dataset, subject)
        camera = sorted(index.cameras)[0]
        source = index.cameras[camera]
        rows = {
            name: {
                "frame": frame,
                "camera": camera,
                "pts": int(source.pts[frame]),
                "dhash": source.dhash[frame],
                "confidence": 1.0,
                "annotator": "truth",
            }
            for name, frame in truth.peaks(subject).items()
        }
        folder = dataset.item_dir("align", subject)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "peaks.json").write_text(json.dumps(rows))


def measure(dataset: Dataset, truth: Truth, preset: str) -> dict:
    """Track every subject and compare with the truth; lengths in millimetres."""
    config = build_config(STAGE, STAGE.presets[preset])
    rows: list[dict[str, float]] = []
    seconds, frames = 0.0, 0
    load_head(config.head)
    pixels = []
    for subject in dataset.subjects():
        with tempfile.TemporaryDirectory() as scratch:
            began = time.perf_counter()
            metrics = STAGE.run(dataset, subject, config, Path(scratch))
            seconds += time.perf_counter() - began
            with np.load(Path(scratch) / "track.npz", allow_pickle=False) as track:
                rows += compare(dataset, truth, subject, track)
                frames += len(track["frames"])
        pixels.append(metrics["landmark_rms_px_mean"])
    summary = {name: float(np.sqrt(np.mean([row[name] ** 2 for row in rows]))) for name in rows[0]}
    return {
        "preset": preset,
        "frames": frames,
        "landmark_px": round(float(np.mean(pixels)), 3),
        "seconds_a_frame": round(seconds / frames, 3),
        **{name: round(value, 3) for name, value in summary.items()},
    }


def compare(
    dataset: Dataset, truth: Truth, subject: str, track: np.lib.npyio.NpzFile
) -> list[dict[str, float]]:
    """RMS distances of one subject's meshes, and of the template laid rigidly on each."""
    model = load_head(str(track["head"]))
    motion = align_worlds(read_cameras_of(dataset, subject), truth.cameras(subject))
    skin = ~(model.regions["mouth_interior"] | model.regions["teeth"]).numpy()
    face = model.regions["face"].numpy()
    template = model.template.double().numpy()
    marks = landmarks(model, model.template[None])[0].double().numpy()
    rows = []
    for vertices, frame in zip(track["vertices"], track["frames"], strict=True):
        moved = vertices @ motion[:3, :3].T + motion[:3, 3]
        true = truth.vertices(subject, int(frame))
        R, t = rigid_fit(marks, truth.landmarks(subject, int(frame)))
        baseline = np.linalg.norm(template @ R.T + t - true, axis=1)
        error = np.linalg.norm(moved - true, axis=1)
        rows.append(
            {
                "vertex_rmse_mm": 1e3 * rms(error),
                "face_rmse_mm": 1e3 * rms(error[face]),
                "skin_rmse_mm": 1e3 * rms(error[skin]),
                "baseline_rigid_template_mm": 1e3 * rms(baseline),
                "baseline_face_mm": 1e3 * rms(baseline[face]),
            }
        )
    return rows


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


if __name__ == "__main__":
    sys.exit(main())
