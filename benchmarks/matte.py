"""Mattes against the twin's true alpha, beside baselines: ``python -m benchmarks.matte --help``.

Frames and plates are undistorted with the true cameras, so that only keying is measured.
Baselines, on the same pictures: ``hard`` (a threshold on the difference from the plate) and
``ramp`` (a soft ramp on the difference over a measured noise), each with the best of the
thresholds listed here, chosen on the truth, which favours them. ``sad`` is the sum of absolute
errors in thousands, ``mse`` is times 1e4 and ``gradient`` the summed squared difference of
Gaussian gradients (Rhemann et al. 2009), each a picture. The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator

import cv2
import numpy as np

from benchmarks.calibrate import add_data_arguments, dataset_and_truth, rounded
from express50.adapters import undistort_image, undistorted_mask
from express50.cameras import pinhole
from express50.config import resolve_config
from express50.frames import read_frame, read_plate
from express50.layout import Dataset
from express50.twin.truth import Truth
from pipelines.matte import STAGE
from pipelines.matte.keyer import Keyer

HARD = (6.0, 10.0, 16.0, 24.0)  # 8-bit steps
RAMP = ((2.0, 8.0), (3.0, 12.0), (3.0, 25.0), (4.0, 40.0))  # noise deviations


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_data_arguments(parser)
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--set", dest="assignments", action="append", default=[])
    parser.add_argument("--pictures", type=int, default=24, help="at most this many")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    dataset, truth = dataset_and_truth(args)
    config = resolve_config(STAGE, args.preset, None, args.assignments)
    rows: dict[str, list[dict[str, float]]] = {}
    for frame, plate, valid, true in pictures(dataset, truth, args.pictures):
        start = time.process_time()
        alpha = Keyer(plate, [frame], valid, config).alpha(frame)
        seconds = time.process_time() - start
        rows.setdefault("matte", []).append(errors(alpha, true) | {"seconds": seconds})
        for name, alpha, seconds in baselines(frame, plate, valid):
            rows.setdefault(name, []).append(errors(alpha, true) | {"seconds": seconds})
    means = {
        name: {key: float(np.mean([row[key] for row in found])) for key in found[0]}
        for name, found in rows.items()
    }
    result: dict[str, object] = {
        "benchmark": "matte",
        "preset": args.preset,
        **rounded(means.pop("matte")),
    }
    best = {
        kind: min((n for n in means if n.startswith(kind)), key=lambda n: means[n]["mae"])
        for kind in ("hard", "ramp")
    }
    result["pictures"] = len(rows["matte"])
    result["baselines"] = {kind: {"setting": n, **rounded(means[n])} for kind, n in best.items()}
    print(json.dumps(result))
    return 0


def pictures(
    dataset: Dataset, truth: Truth, limit: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Frame, plate, valid pixels and true alpha of peaks, an even choice of at most `limit`."""
    every = [
        (subject, camera, frame)
        for subject in dataset.subjects()
        for camera in truth.cameras(subject).values()
        for frame in truth.peaks(subject).values()
    ]
    for i in np.unique(np.linspace(0, len(every) - 1, min(limit, len(every))).round().astype(int)):
        subject, camera, frame = every[i]
        plate = read_plate(dataset, subject, camera.id, undistort=False)
        if plate is None:
            sys.exit(f"{dataset.root}: {subject}/{camera.id} has no plate; name another --dataset")
        image = read_frame(dataset, subject, camera.id, frame, undistort=False)
        valid = undistorted_mask(camera)
        valid = cv2.erode(valid.astype(np.uint8), np.ones((3, 3))) > 0
        true = truth.render_alpha(subject, frame, pinhole(camera)) * valid
        yield undistort_image(image, camera), undistort_image(plate, camera), valid, true


def baselines(
    frame: np.ndarray, plate: np.ndarray, valid: np.ndarray
) -> Iterator[tuple[str, np.ndarray, float]]:
    """Name, alpha (H, W) and seconds of every plain key."""
    start = time.process_time()
    difference = frame.astype(np.float32) - plate
    largest = np.abs(difference).max(axis=-1) * valid
    common = time.process_time() - start
    for threshold in HARD:
        start = time.process_time()
        alpha = (largest > threshold).astype(np.float32)
        yield f"hard {threshold:g}", alpha, common + time.process_time() - start
    start = time.process_time()
    quiet = largest[valid][largest[valid] < 14]
    sigma = max(1.4826 * float(np.median(quiet)) / 1.8, 0.5) if quiet.size else 1.0
    scaled = np.sqrt((difference**2).mean(axis=-1)) / sigma * valid
    common += time.process_time() - start
    for low, high in RAMP:
        start = time.process_time()
        alpha = np.clip((scaled - low) / (high - low), 0, 1)
        yield f"ramp {low:g}-{high:g}", alpha, common + time.process_time() - start


def errors(alpha: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Mean and summed absolute, squared and gradient errors of an alpha (H, W)."""
    off = np.abs(alpha.astype(np.float64) - true)
    gradients = (_gradient(alpha) - _gradient(true)) ** 2
    soft = (true > 0.02) & (true < 0.98)
    return {
        "mae": float(off.mean()),
        "mae_rim": float(off[soft].mean()) if soft.any() else 0.0,
        "sad": float(off.sum() / 1e3),
        "mse": float(1e4 * (off**2).mean()),
        "gradient": float(gradients.sum()),
    }


def _gradient(alpha: np.ndarray) -> np.ndarray:
    """Length (H, W) of the gradient of alpha smoothed by a Gaussian of 1.4 pixels."""
    smooth = cv2.GaussianBlur(alpha.astype(np.float32), (0, 0), 1.4)
    return np.hypot(cv2.Sobel(smooth, -1, 1, 0) / 8, cv2.Sobel(smooth, -1, 0, 1) / 8)


if __name__ == "__main__":
    sys.exit(main())
