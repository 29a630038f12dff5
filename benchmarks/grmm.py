"""Measure GRMM on shards of twin captures: ``python -m benchmarks.grmm OUT [--shards DIR]``.

Eight people, the last never trained on; twelve expressions; twelve cameras of 256 px, two held out;
three frames of training people held out. Footage goes through every stage, so that the shards have
the faults of tracked, matted and fused data. The model and the baseline (texel colours averaged on
the tracked mesh, drawn as Gaussians, nothing trained) are measured in one run, which continues a
stopped one. The unseen person is tracked and fitted from one picture of the frontal camera
and from two; figures that end in ``tracked_from_all_db`` take a track of all cameras. Frame rates
are by the clock, of one process with ``--threads`` threads. `benchmarks.ablate` has the components.
The last line is one JSON object.
"""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.common import make_parser
from benchmarks.demo import record_twin, run_stages, subject_of
from benchmarks.fps import frames_per_second
from benchmarks.given_views import given_shards
from express50.contract.layout import Dataset
from express50.files.atomic import write_json
from express50.geometry.sampling import evenly
from express50.head.load import load_head
from express50.runner.worker import peak_memory
from grmm.ablate import Ablation, ablate
from grmm.checkpoint import Checkpoint, load_checkpoint
from grmm.config import Config, resolve
from grmm.data import HeadViews
from grmm.edit import trained_head
from grmm.evaluate import REGIONS, evaluate, mean, training_render
from grmm.fit import NOVEL_VIEW, FitProtocol, evaluate_unseen
from grmm.metrics import PerceptualMetrics
from grmm.render import draw_views, frontal, orbit, picture, resized
from grmm.shard_source import open_shards
from grmm.train_state import prepare
from grmm.warm_start import warm_start

EXPRESSIONS = (
    "neutral", "smile", "smile_open", "surprise", "jaw_open", "pucker", "funnel", "mouth_left",
    "brow_raise", "wink_left", "nose_wrinkle", "anger",
)  # fmt: skip
TWIN = {"subjects": 8, "first-subject": 51, "cameras": 12, "width": 256, "height": 256,
        "frames-per-expression": 4}  # fmt: skip
HELD_FRAMES = 3
TURN_DEGREES = 3.0  # between pictures of a moving camera


def make_shards(
    out: Path,
    workers: int,
    twin: Mapping[str, int] = TWIN,
    expressions: Sequence[str] = EXPRESSIONS,
    options: Sequence[str] = (),
    people: int = 0,
) -> Path:
    """Record the captures and run every stage over the first ``people`` (0: over all).

    What is done already is kept.
    """
    out.mkdir(parents=True, exist_ok=True)
    record_twin(out / "twin", workers, twin, expressions, options)
    captures = sorted((out / "twin" / "captures").iterdir())
    data, captures = out / f"data{people or ''}", captures[: people or None]
    data.mkdir(exist_ok=True)
    run_stages(data, captures, subject_of(captures[-1]), workers, "grmm.toml")
    return data / "pack" / "shards"


def held_out(shards: Path, config: Config) -> tuple[Config, list[str]]:
    """Return the configuration with its held-out views and frames, and the cameras to fit from.

    Cameras in the order in which they face the first person: the first and the third are fitted
    from, the second and the fifth are held out, one beside the middle and one from the side.
    """
    source = open_shards([shards], "train")
    views = HeadViews(source, load_head(source.head))
    facing: dict[str, float] = {}
    for index, key in enumerate(views.keys):
        if key.camera not in facing:
            facing[key.camera] = float(views.item(index).view.direction()[2])
    order = sorted(facing, key=lambda camera: -facing[camera])
    frames = sorted({(k.subject, k.expression) for k in views.keys if k.expression != "neutral"})
    subjects = evenly(sorted({person for person, _ in frames}), HELD_FRAMES)
    chosen = []
    for number, subject in enumerate(subjects):  # another expression of each
        own = [f"{s}/{e}" for s, e in frames if s == subject]
        chosen.append(own[(1 + number * len(own) // len(subjects)) % len(own)])
    data = replace(
        config.data, holdout_cameras=(order[1], order[4]), holdout_expressions=tuple(chosen)
    )
    return replace(config, data=data), [order[0], order[2]]


def baseline(shards: Path, config: Config, images: int) -> dict[str, float | None]:
    """Return the textured tracked mesh on the held-out cameras."""
    source = open_shards([shards], "train")
    views = HeadViews(source, load_head(source.head))
    torch.manual_seed(config.train.seed)
    run = prepare(views, config)
    warm_start(run.model, views, run.training)
    own = [i for i in run.holdout if views.keys[i].camera in config.data.holdout_cameras]
    rows = evaluate(views, evenly(own, images), training_render(run.model, views))
    return {name: mean(rows, name) for name in ("psnr_db", "psnr_head_db", "ssim", "depth_mm")}


def fit_figures(
    loaded: Checkpoint, shards: Path, given: list[str], out: Path, images: int
) -> dict[str, float | None]:
    """Fit the unseen person from one view and from two, by tracks of these and of all cameras.

    Without the dataset that the shards were packed from, only the latter can be measured.
    """
    source = open_shards([shards], "*")
    subject = next(k.subject for k in source.keys if k.subject not in loaded.model.subjects)
    dataset = Dataset(shards.parents[1])
    found: dict[str, float | None] = {}
    for number, name in enumerate(("one_view", "two_views"), 1):
        cameras = given[:number]
        roots: dict[str, Path | None] = {"tracked_from_all_db": shards, "db": None}
        if dataset.cameras_file(subject).is_file():
            folder, settings = out / f"given_{name}", Path(__file__).with_name("grmm.toml")
            roots["db"] = given_shards(dataset, subject, "neutral", cameras, folder, settings)
        for ending, root in roots.items():
            key = f"psnr_fit_{name}_{ending}"
            found[key] = None if root is None else _fit(loaded, root, cameras, images)
    return found


def _fit(loaded: Checkpoint, shards: Path, cameras: list[str], images: int) -> float | None:
    views = loaded.views(open_shards([shards], "*"))
    subject = next(k.subject for k in views.keys if k.subject not in loaded.model.subjects)
    protocol = FitProtocol(cameras=tuple(cameras), expression="neutral", images=images)
    judge = PerceptualMetrics(loaded.config.metrics)
    rows, _ = evaluate_unseen(loaded, views, subject, protocol, judge)
    return mean([row for row in rows if row["kind"] == NOVEL_VIEW], "psnr_db")


def speeds(loaded: Checkpoint) -> dict[str, float]:
    """Measure frame rates: all from scratch at 256 px; a resting head, moving camera at 512."""
    model = loaded.model
    view, centre = frontal(loaded), model.head_centre
    heads = [
        trained_head(loaded, subject, expression)
        for subject in model.subjects
        for expression in model.expressions
    ]

    def anew() -> Iterator[object]:
        while True:
            for head in heads:
                yield picture(loaded, head, resized(view, 256))

    turns = itertools.cycle([TURN_DEGREES * n for n in range(-15, 16)])
    cameras = (orbit(resized(view, 512), turn, centre) for turn in turns)
    changing, moving = anew(), iter(draw_views(loaded, heads[0], cameras))
    return {
        "render_fps_cpu_256": frames_per_second(lambda: next(changing)),
        "render_fps_cpu_512_cached": frames_per_second(lambda: next(moving)),
    }


def measure(shards: Path, out: Path, iterations: int, images: int) -> dict:
    """Return the figures of the baseline and of the model on one folder of shards."""
    config = resolve("demo", None, [f"train.iterations={iterations}"])
    config, given = held_out(shards, config)
    protocol = FitProtocol(cameras=(given[0],), expression="neutral", images=images)
    run = Ablation(roots=[shards], out=out / "ablation", config=config, protocol=protocol)
    full = ablate(run, ["full"])["rows"]["full"]
    groups = full["groups"]
    loaded = load_checkpoint(out / "ablation" / "full" / "checkpoint.pt")
    return {
        "psnr_heldout_view_db": groups["view"]["psnr_db"],
        "psnr_head_heldout_view_db": groups["view"]["psnr_head_db"],
        **{f"psnr_{r}_heldout_view_db": groups["view"][f"psnr_{r}_db"] for r in REGIONS},
        "ssim_heldout_view": groups["view"]["ssim"],
        "psnr_heldout_expression_db": groups["expression"]["psnr_db"],
        **fit_figures(loaded, shards, given, out, images),
        "psnr_fit_one_view_other_expressions_db": groups["unseen_expression"]["psnr_db"],
        "baseline_textured_tracked_mesh": baseline(shards, config, images),
        "iterations": full["iterations"],
        "iterations_per_second": round(full["iterations"] / full["seconds"], 2),
        "gaussians": full["gaussians"],
        "people": [*loaded.model.subjects],
        "holdout_cameras": list(config.data.holdout_cameras),
        "holdout_expressions": list(config.data.holdout_expressions),
        "fit_from": given,
    } | speeds(loaded)


def main() -> None:
    """Parse, measure, print."""
    parser = make_parser("grmm", __doc__)
    parser.add_argument("out", type=Path, nargs="?", default=Path("build/benchmark_grmm"))
    parser.add_argument("--shards", type=Path, help="packed shards instead of twin captures")
    parser.add_argument("--people", type=int, default=0, help="the first so many of the twin's 8")
    parser.add_argument("--iterations", type=int, default=2000, help="steps of training")
    parser.add_argument("--images", type=int, default=48, help="pictures measured per group")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    shards = args.shards or make_shards(args.out, args.threads, people=args.people)
    torch.set_num_threads(args.threads)
    result = measure(shards, args.out, args.iterations, args.images)
    result |= {"threads": args.threads, "peak_memory_gib": round(peak_memory() / 2**30, 2)}
    write_json(args.out / "grmm.json", result)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
