"""Run the whole chain: footage, every stage, shards, GRMM, an unseen person, a report.

``python -m benchmarks.demo build/demo`` records a small synthetic capture with the digital twin and
runs the same commands that a user would type, each as its own process. With ``--captures`` it takes
captures that exist. Ground truth is opened at the end only, to measure. The last line printed is
one JSON object, also written to ``summary.json``.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

from benchmarks.common import make_parser
from express50.contract.layout import Dataset

# Without `register`: nothing that the demo measures uses its meshes.
STAGES = ("ingest", "calibrate", "align", "frames", "matte", "track", "depth", "regions", "pack")
# Six expressions that between them open the jaw, move brows, lids, lips and cheeks, and are
# one-sided; the fourth subject is never trained on.
EXPRESSIONS = ("neutral", "smile", "jaw_open", "pucker", "brow_raise", "wink_left")
TWIN = {"subjects": 4, "cameras": 8, "width": 320, "height": 320, "frames-per-expression": 6}
TRAIN_SECONDS = 120
FIT_SECONDS = 45
# Figures of `benchmarks.accuracy` that the summary has.
SHOWN = (
    "align.peak_error_frames_median", "matte.mae", "track.vertex_rmse_mm",
    "depth.abs_error_mm_median", "depth.abs_error_mm_p95", "regions.head_mae", "regions.iou_mean",
)  # fmt: skip


@dataclass
class Step:
    """One finished command."""

    name: str
    seconds: float
    peak_bytes: int


class MemoryWatch(threading.Thread):
    """Samples the resident memory of a process and all its children."""

    def __init__(self, pid: int) -> None:
        super().__init__(daemon=True)
        self._process = psutil.Process(pid)
        self._stop_now = threading.Event()
        self.peak_bytes = 0

    def run(self) -> None:
        """Sample until stopped."""
        while not self._stop_now.wait(0.3):
            total = 0
            try:
                for process in [self._process, *self._process.children(recursive=True)]:
                    total += process.memory_info().rss
            except psutil.NoSuchProcess:
                continue
            self.peak_bytes = max(self.peak_bytes, total)

    def stop(self) -> int:
        """Stop and return the peak."""
        self._stop_now.set()
        self.join()
        return self.peak_bytes


def run_step(name: str, module: str, *arguments: str, fails: bool = True) -> Step:
    """Run one command line of the project, its output passed on."""
    command = [sys.executable, "-m", module, *arguments]
    print(f"\n== {name}: {' '.join(command[2:])}", flush=True)
    start = time.perf_counter()
    process = subprocess.Popen(command)
    watch = MemoryWatch(process.pid)
    watch.start()
    code = process.wait()
    step = Step(name, round(time.perf_counter() - start, 1), watch.stop())
    print(f"== {name}: {step.seconds} s, exit {code}", flush=True)
    if code and fails:
        sys.exit(f"demo: step {name} failed with exit code {code}; see its lines above")
    return step


def record_twin(
    root: Path,
    workers: int,
    twin: Mapping[str, int] = TWIN,
    expressions: Sequence[str] = EXPRESSIONS,
    options: Sequence[str] = (),
) -> list[Step]:
    """Record the synthetic captures unless the same ones are there already."""
    settings = json.dumps({**twin, "expressions": expressions, "options": options})
    stamp = root / "recorded.json"
    if stamp.exists() and stamp.read_text() == settings:
        return []
    shutil.rmtree(root, ignore_errors=True)
    flags = [f"--{key}={value}" for key, value in twin.items()]
    flags += [
        f"--expressions={','.join(expressions)}",
        f"--workers={workers}",
        "--seed=0",
        *options,
    ]
    step = run_step("record", "express50", "twin", "record", str(root), *flags)
    stamp.write_text(settings)
    return [step]


def subject_of(capture: Path) -> str:
    """Read the subject named in a capture."""
    import tomllib

    return tomllib.loads((capture / "capture.toml").read_text())["subject"]


def run_stages(
    dataset: Path, captures: list[Path], unseen: str, workers: int, settings: str = "demo.toml"
) -> list[Step]:
    """Run every stage over the dataset; a failed item is reported, and the chain continues."""
    common = ["--workers", str(workers), "--config", str(Path(__file__).with_name(settings))]
    steps = []
    for stage in STAGES:
        extra = [str(c) for c in captures] if stage == "ingest" else []
        if stage == "pack":
            extra += ["--set", f'pack.test_subjects=["{unseen}"]']
        steps.append(
            run_step(stage, "express50", stage, str(dataset), *extra, *common, fails=False)
        )
    return steps


def pick_views(dataset: Dataset, subject: str) -> tuple[str, list[str]]:
    """Choose a held-out camera and the two that the unseen person is fitted from.

    By the calibrated rig alone: cameras are ordered by their angle to the camera that saw the face
    best in alignment; the nearest other one is held out, the best and the next are given.
    """
    import numpy as np

    from express50.capture.frames import read_cameras_of

    cameras = read_cameras_of(dataset, subject)
    metrics = json.loads((dataset.item_dir("observe", subject) / "metrics.json").read_text())
    best = next(c for c in metrics["watching_cameras"] if c in cameras)
    forward = {c: camera.cam_from_world[2, :3] for c, camera in cameras.items()}
    ordered = sorted(cameras, key=lambda c: -float(np.dot(forward[c], forward[best])))
    return ordered[1], [ordered[0], ordered[2]]


def run_grmm(dataset: Path, unseen: str, seconds: tuple[int, int]) -> list[Step]:
    """Train on the shards, track and fit the unseen person from two views, render."""
    shards, out = dataset / "pack" / "shards", dataset / "grmm"
    train_subject = next(s for s in Dataset(dataset).subjects() if s != unseen)
    held_out, _ = pick_views(Dataset(dataset), train_subject)
    _, given = pick_views(Dataset(dataset), unseen)
    checkpoint = str(out / "train" / "checkpoint.pt")
    expression = json.loads((dataset / "align" / unseen / "peaks.json").read_text())
    shown = "neutral" if "neutral" in expression else sorted(expression)[0]
    # What is fitted comes from the given views alone; beside it, a track of all cameras.
    alone, fitted = out / "given", (f"--subject={unseen}", f"--expression={shown}",
                                    f"--cameras={','.join(given)}")  # fmt: skip
    return [
        run_step(
            "track_given", "benchmarks.given_views", str(dataset), str(alone), *fitted,
        ),
        run_step(
            "train", "grmm", "train", str(shards), str(out / "train"), "--overwrite",
            "--preset=demo", f"--seconds={seconds[0]}", f"--holdout-cameras={held_out}",
        ),
        run_step(
            "fit", "grmm", "fit", checkpoint, str(alone / "shards"), str(out / "fit"),
            "--overwrite", *fitted, f"--seconds={seconds[1]}",
        ),
        run_step(
            "fit_all_cameras", "grmm", "fit", checkpoint, str(shards), str(out / "fit_all_cameras"),
            "--overwrite", *fitted, f"--seconds={seconds[1]}",
        ),
        run_step("render", "grmm", "render", checkpoint, str(out / "render"), "--turntable"),
    ]  # fmt: skip


def summarise(dataset: Path, truth: Path | None, steps: list[Step]) -> dict:
    """Collect the figures of the run; a figure that was not measured is null."""

    def metric(path: str, key: str) -> float | None:
        file = dataset / path / "metrics.json"
        return json.loads(file.read_text()).get(key) if file.exists() else None

    accuracy = {}
    if truth is not None:
        from benchmarks.accuracy import measure_dataset

        accuracy = measure_dataset(Dataset(dataset), truth, dataset / "accuracy")
    subjects = Dataset(dataset).subjects()
    reprojection = [
        value
        for s in subjects
        if (value := metric(f"calibrate/{s}", "reprojection_px")) is not None
    ]
    return {
        "seconds": {step.name: step.seconds for step in steps},
        "seconds_total": round(sum(step.seconds for step in steps), 1),
        "peak_memory_gib": round(max(step.peak_bytes for step in steps) / 2**30, 2),
        "calibrate.reprojection_px": max(reprojection) if reprojection else None,
        **{name: accuracy.get(name) for name in SHOWN},
        "train.psnr_heldout_view_db": metric("grmm/train", "psnr_heldout_view_db"),
        "train.iterations_per_second": metric("grmm/train", "iterations_per_second"),
        "fit.psnr_db": metric("grmm/fit", "psnr_db"),
        "fit.psnr_tracked_from_all_cameras_db": metric("grmm/fit_all_cameras", "psnr_db"),
    }


def main() -> None:
    """Run the demo."""
    parser = make_parser("demo", __doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--captures", type=Path, nargs="+", help="raw captures instead of the twin")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--train-seconds", type=int, default=TRAIN_SECONDS)
    parser.add_argument("--fit-seconds", type=int, default=FIT_SECONDS)
    args = parser.parse_args()
    if args.captures and len(args.captures) < 2:
        parser.error("--captures: expected two or more, as training leaves out the last person")
    name = "demo" if args.captures is None else "+".join(c.name for c in args.captures)
    dataset, truth, steps = args.out / "data" / name, None, []
    captures = args.captures
    if captures is None:
        steps += record_twin(args.out / "twin", args.workers)
        captures = sorted((args.out / "twin" / "captures").iterdir())
        truth = args.out / "twin" / "truth"
    unseen = subject_of(captures[-1])
    dataset.mkdir(parents=True, exist_ok=True)
    steps += run_stages(dataset, captures, unseen, args.workers)
    steps += run_grmm(dataset, unseen, (args.train_seconds, args.fit_seconds))
    summary = summarise(dataset, truth, steps)
    (dataset / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    steps.append(
        run_step(
            "report", "express50", "report", str(dataset),
            "--out", str(args.out / "report"), "--title", f"EXPRESS-50 demo: {name}",
        )
    )  # fmt: skip
    summary["seconds"]["report"] = steps[-1].seconds
    summary["seconds_total"] = round(sum(step.seconds for step in steps), 1)
    (args.out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    print(json.dumps(summary))


if __name__ == "__main__":
    main()
