"""The bump head as an ingested, calibrated, aligned, matted and tracked dataset."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.common import write_peaks
from express50.contract.layout import Dataset
from express50.contract.stage import Stage
from express50.files.calibration import write_cameras
from express50.files.images import write_image
from express50.geometry.cameras import Camera
from express50.head.load import load_head
from express50.runner.executor import Pool
from express50.runner.runner import run_stage
from pipelines import frames, ingest
from tests.pipelines.bump_head import BACKGROUND, render, ring
from tests.stages import run_here

EXPRESSIONS = ("neutral", "smile")


def make_dataset(
    root: Path, subjects: tuple[str, ...] = ("S001",), cameras: int = 6, size: int = 96
) -> Dataset:
    """Write captures, ingest them, and put down what the stages up to track would write.

    They have plates: without, `frames` would take half a minute to look for walls.
    """
    dataset = Dataset(root / "data")
    rig = ring(cameras, size)
    shots = {camera.id: render(camera) for camera in rig}
    for subject in subjects:
        capture = root / "raw" / subject
        _write_capture(capture, subject, rig, shots)
        ingest.add_captures(dataset, [capture])
    run_here(ingest.STAGE, dataset)
    for subject in subjects:
        write_given(dataset, subject, rig, shots)
    run_here(frames.STAGE, dataset)
    return dataset


def _write_capture(capture: Path, subject: str, rig: list[Camera], shots: dict) -> None:
    capture.mkdir(parents=True)
    (capture / "capture.toml").write_text(
        f'subject = "{subject}"\nfps = 24\nconsent = "C-{subject}"\nlicence = "CC0-1.0"\n'
        'gender = "feminine"\nage = 4711e-2\n'
    )
    rows = [f"{name},{k},{k}" for k, name in enumerate(EXPRESSIONS)]
    (capture / "cues.csv").write_text("expression_id,start_frame,end_frame\n" + "\n".join(rows))
    write_cameras(capture / "calibration.json", {camera.id: camera for camera in rig})
    for name, (rgb, _, _) in shots.items():
        folder = capture / "cameras" / name / "frames"
        folder.mkdir(parents=True)
        for k in range(len(EXPRESSIONS)):
            write_image(folder / f"{k:06d}.png", rgb)
        plate = np.broadcast_to(np.rint(255 * BACKGROUND).astype(np.uint8), rgb.shape)
        (capture / "plates").mkdir(exist_ok=True)
        write_image(capture / "plates" / f"{name}.png", plate)


def write_given(dataset: Dataset, subject: str, rig: list[Camera], shots: dict) -> None:
    """Outputs of calibrate, align, matte and track."""
    for stage in ("calibrate", "track"):
        dataset.item_dir(stage, subject).mkdir(parents=True)
    cameras = {camera.id: replace(camera) for camera in rig}
    write_cameras(dataset.cameras_file(subject), cameras)
    write_peaks(dataset, subject, {name: k for k, name in enumerate(EXPRESSIONS)}, "tester")
    for name, (_, alpha, _) in shots.items():
        for expression in EXPRESSIONS:
            path = dataset.matte_file(subject, expression, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_image(path, np.rint(alpha * 255).astype(np.uint8))
    write_track(dataset, subject)


def write_track(dataset: Dataset, subject: str) -> None:
    """A track of the built-in head, squeezed until most of it lies in the ellipsoid."""
    head = load_head("procedural")
    template = head.template.numpy()
    low, high = template.min(0), template.max(0)
    count = len(EXPRESSIONS)
    t = -(low + high) / 2
    scale = np.array([0.14, 0.2, 0.17]) / (high - low)
    arrays = {
        "schema": "express50.track/2",
        "head": "procedural",
        "expressions": np.array(EXPRESSIONS),
        "frames": np.arange(count),
        "shape": np.zeros(4),
        "expression": np.zeros((count, 3)),
        "neck": np.zeros((count, 3)),
        "jaw": np.zeros((count, 3)),
        "eyes": np.zeros((count, 6)),
        "R": np.stack([np.eye(3)] * count),
        "t": np.stack([t] * count),
        "vertices": np.stack([((template + t) * scale).astype(np.float32)] * count),
        "offsets": np.zeros((len(template), 3), np.float32),
    }
    np.savez(dataset.track_file(subject), **arrays)


def published(dataset: Dataset, stage: Stage, config: object) -> dict:
    """Run a stage in this process; returns the metrics of its items."""
    run_stage(stage, dataset, config, pool=Pool(0), progress=False)
    found = {}
    for item in stage.items(dataset):
        path = dataset.item_dir(stage.name, item) / "metrics.json"
        if path.is_file():
            found[item] = json.loads(path.read_text())
    return found
