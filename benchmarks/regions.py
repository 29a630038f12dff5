"""Measure labels and head mattes against the twin's truth: ``python -m benchmarks.regions``.

The stage (``standard``) labels items from their mattes, tracks and depth maps. Beside it stand
simpler ways to lose the torso: keep it (``no_cut``), cut along the image row of the tracked chin
(``chin_line``) or of the neck's tracked end (``neck_line``); and two limits: the stage on the true
mesh instead of the tracked one (``true_mesh``), and the same matte without the pixels that
truly show torso (``true_cut``), whose error is the matte's own. IoU of a part is over the pixels
of all views in which the truth or the labels have it. Seconds are processor seconds per view,
reading included. The last line is one JSON object.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from benchmarks.accuracy import true_world_cameras
from benchmarks.common import make_parser
from benchmarks.regions_truth import iou_figures, true_head_alpha, true_labels, view_row
from benchmarks.truth import Truth
from express50.capture.frames import read_cameras_of
from express50.capture.index import read_peaks
from express50.contract.config import resolve_config
from express50.contract.layout import Dataset
from express50.contract.segmentation_labels import TORSO
from express50.dataset.tracks import read_track
from express50.files.images import read_image
from express50.geometry.cameras import project
from express50.geometry.sampling import evenly
from express50.head.load import load_head
from express50.head.model import landmarks
from pipelines.regions import STAGE, RegionsConfig
from pipelines.regions.geometry import head_alpha, head_labels, make_head
from pipelines.regions.stage import label_view, read_depth_of, read_frame_and_matte, read_head

CHIN = 8  # of the 68 landmarks

Pair = tuple[np.ndarray, np.ndarray]
"""True labels and alpha of the head (H, W) of a view."""


def main() -> int:
    """Run and print the figures."""
    parser = make_parser("regions", __doc__)
    parser.add_argument("--dataset", type=Path, default=Path("build/demo/data/demo"))
    parser.add_argument("--truth", type=Path, default=Path("build/demo/twin/truth"))
    parser.add_argument("--set", dest="assignments", action="append", default=[])
    parser.add_argument("--items", type=int, default=4, help="this many, evenly chosen; 0: all")
    args = parser.parse_args()
    dataset, truth = Dataset(args.dataset), Truth(args.truth)
    items = [i for i in STAGE.items(dataset) if dataset.item_dir("depth", i).is_dir()]
    if not items:
        sys.exit(f"{args.dataset}: no depth maps; run 'make demo' or name --dataset and --truth")
    if args.items:
        items = evenly(items, args.items)
    config = resolve_config(STAGE, "standard", None, args.assignments)
    rows: dict[str, list[dict]] = {}
    for item in items:
        for name, row in measure_item(dataset, truth, item, config).items():
            rows.setdefault(name, []).append(row)
    result = {name: summary(found) for name, found in rows.items()}
    for name, figures in result.items():
        print(name, figures)
    print(json.dumps({"benchmark": "regions", "items": items, **result}))
    return 0


def measure_item(
    dataset: Dataset, truth: Truth, item: str, config: RegionsConfig
) -> dict[str, dict]:
    """Measure the stage and every baseline on one item."""
    subject, expression = item.split("/")
    frame = read_peaks(dataset, subject)[expression]
    cameras = true_world_cameras(dataset, truth, subject)
    true = {
        name: (
            true_labels(truth, subject, frame, camera),
            true_head_alpha(truth, subject, frame, camera, rays=4),
        )
        for name, camera in cameras.items()
    }
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        start = time.process_time()
        STAGE.run(dataset, item, config, out)
        seconds = time.process_time() - start
        rows = [
            view_row(*true[name], read_image(out / f"{name}_head.png") / 255.0,
                     read_image(out / f"{name}.png"))
            for name in true
        ]  # fmt: skip
    found: dict[str, dict] = {"standard": {"rows": rows, "seconds": seconds / len(true)}}
    found["true_mesh"] = {"rows": true_mesh_rows(dataset, truth, item, true), "seconds": None}
    matte = baselines(dataset, item)["no_cut"]
    shown = {name: matte(name) * (labels != TORSO) for name, (labels, _) in true.items()}
    rows = [view_row(*true[name], shown[name], None) for name in true]
    found["true_cut"] = {"rows": rows, "seconds": None}
    for name, cut in baselines(dataset, item).items():
        rows = [view_row(*true[camera], cut(camera), None) for camera in true]
        found[name] = {"rows": rows, "seconds": None}
    return found


def true_mesh_rows(
    dataset: Dataset, truth: Truth, item: str, true: Mapping[str, Pair]
) -> list[dict]:
    """Measure the stage with perfect tracking."""
    subject, expression = item.split("/")
    frame = read_peaks(dataset, subject)[expression]
    labels = head_labels(truth.head_model(subject))
    R = truth.parameters(subject, frame)["R"]
    head = make_head(truth.vertices(subject, frame), R, labels)
    rows = []
    for name, camera in true_world_cameras(dataset, truth, subject).items():
        rgb, alpha = read_frame_and_matte(dataset, item, camera)
        depth = read_depth_of(dataset, item, camera)
        small = label_view(head, camera, rgb, alpha, depth, False, STAGE.config().image_side).labels
        shown = np.where(alpha > 0.5, small, 0)
        labels_of, alpha_of = true[name]
        rows.append(view_row(labels_of, alpha_of, head_alpha(alpha, small), shown))
    return rows


def baselines(dataset: Dataset, item: str) -> dict[str, Callable[[str], np.ndarray]]:
    """Make head mattes (H, W) by camera: the matte as it is, and cut at an image row."""
    subject, expression = item.split("/")
    cameras = read_cameras_of(dataset, subject)
    head, _ = read_head(dataset, subject, expression)
    path = dataset.track_file(subject)
    model = load_head(read_track(path).head)
    chin = landmarks(model, model.template.new_tensor(head.vertices)[None])[0, CHIN].numpy()
    end = head.vertices[head.labels.end]

    def matte(name: str) -> np.ndarray:
        return read_image(dataset.matte_file(subject, expression, name)) / 255.0

    def above(name: str, points: np.ndarray) -> np.ndarray:
        row = float(project(cameras[name], points.reshape(-1, 3))[0][:, 1].mean())
        shares = np.clip(row - np.arange(cameras[name].height), 0, 1)  # of each row of pixels
        return matte(name) * shares[:, None]

    return {
        "no_cut": matte,
        "chin_line": lambda name: above(name, chin),
        "neck_line": lambda name: above(name, end),
    }


def summary(items: list[dict]) -> dict:
    """Average over all views; a part that neither truth nor labels have is None."""
    rows = [row for item in items for row in item["rows"]]
    seconds = [item["seconds"] for item in items if item["seconds"] is not None]
    return {
        "head_sad_px": round(float(np.mean([row["sad"] for row in rows])), 1),
        "head_mae": round(float(np.mean([row["mae"] for row in rows])), 5),
        **(iou_figures(rows) if any(row["either"].any() for row in rows) else {}),
        "seconds_per_view": round(float(np.mean(seconds)), 3) if seconds else None,
        "views": len(rows),
    }


if __name__ == "__main__":
    raise SystemExit(main())
