"""GRMM at demo size: ``python -m benchmarks.grmm [--shards DIR --holdout CAMERA]``.

Without shards a twin capture is recorded and its truth stands in for tracking, matte and depth, so
that the numbers are the trainer's alone. One camera is held out. In the same run: the full model,
the model without refinement (ablation), and the baseline, the textured tracked mesh: texel colours
averaged from the same footage on the tracked mesh, drawn as Gaussians, nothing trained. Step times
are process CPU seconds, so that other work on the machine disturbs them little. The last line is
one JSON object.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from express50.adapters import undistort_image
from express50.cameras import pinhole
from express50.head.load import load_head
from express50.images import read_image
from express50.twin.config import TwinConfig
from express50.twin.record import record
from express50.twin.truth import Truth
from grmm.config import Config
from grmm.data import HeadViews, Key, Sample, Source, Tracked, spread
from grmm.evaluate import evaluate, mean, training_render
from grmm.presets import resolve
from grmm.shard_source import ShardSource
from grmm.train import Run, finished, prepare, set_rates, step
from grmm.warm_start import warm_start

EXPRESSIONS = ("neutral", "smile", "jaw_open", "brow_raise")


class TwinSource:
    """Peak frames of a recording, with true parameters, matte and depth."""

    head = "procedural"

    def __init__(self, root: Path) -> None:
        """Open ``root`` as `record` wrote it, with PNG footage."""
        self.root, self.truth = root, Truth(root / "truth")
        self.keys: Sequence[Key] = [
            Key(subject=subject, expression=expression, camera=camera)
            for subject in self.truth.subjects()
            for expression in sorted(self.truth.peaks(subject))
            for camera in sorted(self.truth.cameras(subject))
        ]

    def read(self, index: int) -> Sample:
        """Undistorted footage of one view with its truth."""
        key = self.keys[index]
        frame = self.truth.peaks(key.subject)[key.expression]
        distorted = self.truth.cameras(key.subject)[key.camera]
        camera = pinhole(distorted)
        path = self.root / "captures" / key.subject / "cameras" / key.camera / "frames"
        picture = undistort_image(read_image(path / f"{frame:06d}.png"), distorted)
        known = self.truth.parameters(key.subject, frame)
        depth, valid = self.truth.render_depth(key.subject, frame, camera)
        alpha = self.truth.render_alpha(key.subject, frame, camera)
        names = ("shape", "expression", "neck", "jaw", "eyes", "R", "t")
        return Sample(
            image=picture,
            alpha=(255 * alpha).round().astype("uint8"),
            depth=depth * valid,
            K=camera.K,
            cam_from_world=camera.cam_from_world,
            tracked=Tracked(**{name: known[name] for name in names}),
        )


def train_model(views: HeadViews, config: Config) -> tuple[Run, float]:
    """Train for the configured iterations; returns the run and the median CPU seconds a step."""
    torch.manual_seed(config.train.seed)
    run = prepare(views, config)
    warm_start(run.model, views, run.training, config.train.warm_start_images)
    seconds = []
    while not finished(run, config):
        began = time.process_time()
        set_rates(run, config)
        step(run, run.model, config)
        run.iteration += 1
        seconds.append(time.process_time() - began)
    return run, sorted(seconds)[len(seconds) // 2] if seconds else 0.0


def scores(run: Run, images: int = 24) -> dict[str, float | None]:
    """Means over held-out views."""
    render = training_render(run.model, run.views)
    rows = evaluate(run.views, spread(run.holdout, images), render)
    return {name: mean(rows, name) for name in ("psnr_db", "psnr_head_db", "ssim", "depth_mm")}


def measure(source: Source, holdout: str, iterations: int) -> dict[str, object]:
    """Full model, ablation and baseline on one source."""
    config = resolve("demo", None, [f'data.holdout_cameras=["{holdout}"]'])
    config = replace(config, train=replace(config.train, iterations=iterations))
    views = HeadViews(source, load_head(source.head))
    results: dict[str, object] = {}
    untrained = prepare(views, config)
    warm_start(untrained.model, views, untrained.training, config.train.warm_start_images)
    results["baseline_textured_tracked_mesh"] = scores(untrained)
    plain = replace(config, model=replace(config.model, refine_widths=()))
    for name, settings in (("full", config), ("no_refinement", plain)):
        run, seconds = train_model(views, settings)
        results[name] = scores(run) | {"cpu_seconds_per_step": round(seconds, 4)}
    return results | {
        "gaussians": len(untrained.model.texels),
        "training_views": len(untrained.training),
        "heldout_views": len(untrained.holdout),
        "iterations": iterations,
        "image_px": views.sample(0).alpha.shape[0],
        "threads": torch.get_num_threads(),
    }


def main() -> None:
    """Parse, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shards", type=Path, help="packed shards instead of a twin recording")
    parser.add_argument("--holdout", default="cam03", help="camera to hold out")
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--size", type=int, default=192, help="side of the twin's pictures")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.shards is not None:
        print(json.dumps(measure(ShardSource(args.shards), args.holdout, args.iterations)))
        return
    with tempfile.TemporaryDirectory() as folder:
        config = TwinConfig(
            subjects=2,
            cameras=7,
            width=args.size,
            height=args.size,
            expressions=EXPRESSIONS,
            frames_per_expression=4,
            footage="png",
            board_frames=0,
            give_calibration=True,
        )
        record(config, Path(folder), workers=1)
        print(json.dumps(measure(TwinSource(Path(folder)), args.holdout, args.iterations)))


if __name__ == "__main__":
    main()
