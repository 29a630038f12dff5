"""Measure mattes against known alpha, beside plain keys and textbook matting.

``python -m benchmarks.matte`` draws scenes (`benchmarks.matte_scenes`: dark, blond and frizzy
strands, each before a plain and a cluttered plate) and keys them;
with ``--twin`` it keys the peaks of the demo's twin too, undistorted with the true cameras so that
only keying is measured.

Baselines on the same pictures, with the plate in the frame's exposure as the key has it:
``hard_key`` (a threshold on the difference), ``soft_key`` (a ramp on the difference in measured
noise deviations), both with the best of many thresholds for each picture, chosen on the truth,
which favours them; ``guided_filter`` of the soft key by the frame, and PyMatting's
``closed_form`` on a trimap made from the soft key. ``mae`` is the mean absolute error, ``sad`` its
sum in thousands, ``mse`` is times 1e4 and ``gradient_error`` the summed squared difference of
Gaussian gradients (Rhemann et al. 2009), all means over pictures. ``*_ratio_to_soft_key_rim``
count the pixels within 8 of soft ones alone: no shadow on the backdrop, no spot inside the subject.
``composite_error`` is that of the subject's light before black in soft pixels, times 1000, with its
own colours estimated as `pack` does; ``composite_error_footage`` with the frame's colours.
The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np

from benchmarks.common import make_parser, means, recorded, rounded, true_pictures
from benchmarks.matte_scenes import Scene, make_scenes
from benchmarks.truth import Truth
from express50.contract.layout import Dataset
from express50.geometry.pixels import srgb_to_linear
from express50.geometry.sampling import evenly
from express50.twin import TwinConfig
from pipelines.matte import MatteConfig
from pipelines.matte.key import dilated, eroded, key_alpha
from pipelines.matte.plates import exposed, exposure_gain
from pipelines.pack.sample import own_colours

HARD = (4.0, 6.0, 10.0, 16.0, 24.0, 40.0)  # 8-bit steps
LOW, HIGH = (2.0, 4.0, 8.0, 16.0, 32.0), (12.0, 25.0, 40.0, 60.0, 90.0)  # noise deviations
RIM = 8.0  # pixels
SMALL = TwinConfig(
    subjects=2, cameras=6, width=384, height=384, expressions=("neutral", "jaw_open"),
    frames_per_expression=4,
)  # fmt: skip
Rows = dict[str, list[dict[str, float]]]


def main() -> int:
    """Run and print."""
    parser = make_parser("matte", __doc__)
    parser.add_argument("--dataset", type=Path, default=Path("build/demo/data/demo"))
    parser.add_argument("--truth", type=Path, default=Path("build/demo/twin/truth"))
    parser.add_argument("--small", type=Path, default=Path("build/bench-twin"))
    parser.add_argument("--size", type=int, default=640, help="pixels of a scene's side")
    parser.add_argument("--twin", action="store_true", help="measure on the twin too")
    parser.add_argument("--pictures", type=int, default=24, help="of the twin, at most")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    result: dict[str, object] = {"benchmark": "matte", "size": args.size}
    result |= measured(make_scenes(args.size))
    if args.twin:
        twin = pictures(*dataset_and_truth(args), args.pictures)
        result["twin"] = measured(twin, textbook=False)
    print(json.dumps(rounded(result)))
    return 0


def measured(found: Iterable[Scene], textbook: bool = True) -> dict[str, object]:
    """Return means over pictures of our key and every baseline, and ratios to the soft key."""
    rows: Rows = {}
    shadow = MatteConfig().shadow
    for picture in found:
        start = time.process_time()
        alpha = key_alpha(picture.frame, picture.plate, picture.valid, shadow)
        _add(rows, "standard", alpha, picture, time.process_time() - start)
        for name, alpha, seconds in baselines(picture, textbook):
            _add(rows, name, alpha, picture, seconds)
        print(picture.name, rounded({n: r[-1]["sad"] for n, r in rows.items()}), file=sys.stderr)
    table = {name: means(mine) for name, mine in rows.items()}
    soft, ours = table["soft_key"], table["standard"]
    for key in ("sad", "gradient_error", "sad_rim", "gradient_error_rim"):
        short = key.replace("_error", "").replace("_rim", "")
        end = "_rim" if key.endswith("_rim") else ""
        ours[f"{short}_ratio_to_soft_key{end}"] = ours[key] / soft[key]
    return {"pictures": len(rows["soft_key"]), **table}


def _add(rows: Rows, name: str, alpha: np.ndarray, picture: Scene, seconds: float) -> None:
    row = errors(alpha, picture.true)
    row["seconds_per_megapixel"] = 1e6 * seconds / alpha.size
    if picture.front is not None:
        row |= composite_errors(alpha, picture)
    rows.setdefault(name, []).append(row)


def composite_errors(alpha: np.ndarray, picture: Scene) -> dict[str, float]:
    """Return the error of the subject before black, mean absolute light in soft pixels, times 1000.

    `composite_error` with the subject's own colours as estimated, `composite_error_footage` with
    the frame's colours.
    """
    steps = np.rint(255 * np.clip(alpha, 0, 1)).astype(np.uint8)
    plate = exposed(picture.plate, exposure_gain(picture.frame, picture.plate))
    soft = (steps > 0) & (steps < 255) | (picture.true > 0) & (picture.true < 1)
    found = {}
    own = own_colours(picture.frame, steps, plate)
    for name, image in (("composite_error", own), ("composite_error_footage", picture.frame)):
        light = srgb_to_linear(image / 255.0) * (steps / 255.0)[..., None]
        found[name] = 1e3 * float(np.abs(light - picture.front)[soft].mean())
    return found


def pictures(dataset: Dataset, truth: Truth, limit: int) -> Iterator[Scene]:
    """Yield peaks of the twin, an even choice of at most `limit`."""
    every = [
        (subject, camera, frame)
        for subject in dataset.subjects()
        for camera in truth.cameras(subject).values()
        for frame in truth.peaks(subject).values()
    ]
    for subject, camera, frame in evenly(every, limit):
        name = f"{subject} {camera.id} {frame}"
        yield Scene(name=name, **true_pictures(dataset, truth, subject, camera, frame))


def dataset_and_truth(args: argparse.Namespace) -> tuple[Dataset, Truth]:
    """Return the named dataset, or a small one recorded for the purpose."""
    dataset = Dataset(args.dataset)
    if dataset.captures_file.is_file():
        return dataset, Truth(args.truth)
    print(f"{dataset.root}: not there; recording a small twin in {args.small}", file=sys.stderr)
    return recorded(SMALL, args.small)


def baselines(picture: Scene, textbook: bool) -> Iterator[tuple[str, np.ndarray, float]]:
    """Name, alpha (H, W) and seconds of every plain key and, if asked for, textbook method."""
    start = time.process_time()
    frame, valid = picture.frame, picture.valid
    shown = exposed(picture.plate, exposure_gain(frame, picture.plate))
    difference = frame.astype(np.float32) - shown
    largest = np.abs(difference).max(axis=-1) * valid
    keys = [(largest > threshold).astype(np.float32) for threshold in HARD]
    seconds = (time.process_time() - start) / len(HARD)
    yield "hard_key", _best(keys, picture), seconds
    start = time.process_time()
    quiet = largest[valid][largest[valid] < 14]
    sigma = max(1.4826 * float(np.median(quiet)) / 1.8, 0.5) if quiet.size else 1.0
    scaled = np.sqrt((difference**2).mean(axis=-1)) / sigma * valid
    ramps = [
        np.clip((scaled - low) / (high - low), 0, 1) for low in LOW for high in HIGH if low < high
    ]
    seconds = (time.process_time() - start) / len(ramps)
    soft = _best(ramps, picture)
    yield "soft_key", soft, seconds
    if textbook:
        start = time.process_time()
        filtered = guided_filter(frame, soft, radius=4, epsilon=1e-4)
        yield "guided_filter", filtered, seconds + time.process_time() - start
        alpha, spent = closed_form(frame, soft)
        yield "closed_form", alpha, seconds + spent


def _best(alphas: list[np.ndarray], picture: Scene) -> np.ndarray:
    return min(alphas, key=lambda alpha: float(np.abs(alpha - picture.true).mean()))


def guided_filter(frame: np.ndarray, alpha: np.ndarray, radius: int, epsilon: float) -> np.ndarray:
    """Return the alpha (H, W) filtered by a frame's (H, W, 3) colours (He, Sun and Tang 2010)."""
    guide = frame / 255.0
    side = (2 * radius + 1, 2 * radius + 1)

    def mean(values: np.ndarray) -> np.ndarray:
        return cv2.blur(values, side)

    products = guide[..., :, None] * guide[..., None, :]
    centre, average = mean(guide), mean(alpha.astype(np.float64))
    covariance = mean(products.reshape(*alpha.shape, 9)).reshape(products.shape)
    covariance -= centre[..., :, None] * centre[..., None, :]
    together = mean(guide * alpha[..., None]) - centre * average[..., None]
    slope = np.linalg.solve(covariance + epsilon * np.eye(3), together[..., None])[..., 0]
    offset = mean(average - np.einsum("...i,...i->...", slope, centre))
    return np.clip(np.einsum("...i,...i->...", mean(slope), guide) + offset, 0, 1)


def closed_form(frame: np.ndarray, soft: np.ndarray) -> tuple[np.ndarray, float]:
    """Solve Levin's closed form on a trimap of the soft key, and its seconds."""
    from pymatting import estimate_alpha_cf

    radius = max(2.0, max(soft.shape) / 160)
    trimap = np.full(soft.shape, 0.5)
    trimap[eroded(soft > 0.95, radius)] = 1.0
    trimap[~dilated(soft > 0.05, radius)] = 0.0
    start = time.process_time()
    alpha = estimate_alpha_cf(frame / 255.0, trimap)
    return alpha, time.process_time() - start


def errors(alpha: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Return the mean and summed absolute, squared and gradient errors of an alpha (H, W)."""
    off = np.abs(alpha.astype(np.float64) - true)
    gradients = (_gradient(alpha) - _gradient(true)) ** 2
    soft = (true > 0.02) & (true < 0.98)
    rim = dilated(soft, RIM) if soft.any() else soft
    return {
        "mae": float(off.mean()),
        "mae_rim": float(off[soft].mean()) if soft.any() else 0.0,
        "sad": float(off.sum() / 1e3),
        "sad_rim": float(off[rim].sum() / 1e3),
        "mse": float(1e4 * (off**2).mean()),
        "gradient_error": float(gradients.sum()),
        "gradient_error_rim": float(gradients[rim].sum()),
    }


def _gradient(alpha: np.ndarray) -> np.ndarray:
    """Return the length (H, W) of the gradient of alpha smoothed by a Gaussian of 1.4 pixels."""
    smooth = cv2.GaussianBlur(alpha.astype(np.float32), (0, 0), 1.4)
    return np.hypot(cv2.Sobel(smooth, -1, 1, 0) / 8, cv2.Sobel(smooth, -1, 0, 1) / 8)


if __name__ == "__main__":
    sys.exit(main())
