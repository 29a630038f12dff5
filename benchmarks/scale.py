"""Measure the whole chain at real size: core seconds per moment, memory per worker, errors.

``python -m benchmarks.scale OUT`` records one moment (one expression of one person) with 24 cameras
of 3840 x 2160, without a board, and runs every stage with each preset, every stage in a process of
its own. ``--cameras`` and ``--size`` make smaller ones; the footage is recorded again if they
change. What a stage does once per subject counts in full, as if the subject had one expression.
``--smaller`` names sizes at which the same is run; from their receipts `express50.cli.plan`
predicts the large one, and from the receipts of all sizes EXPRESS-50 with clips as short as these.
The last line printed is one JSON object: ``<preset>``'s ``core_seconds_per_moment`` and
``peak_memory_gib``, both also by stage, the errors against the truth, those at the smaller sizes,
``plan_core_seconds``, ``plan_off_percent``: prediction against what the items took, and
``express_50``: core hours with their interval, and core seconds per moment, by stage too.
"""

from __future__ import annotations

import json
import multiprocessing
import shutil
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from express50.cli.plan import estimate, measure, measure_sizes, target_of, totals
from express50.contract.config import resolve_config
from express50.contract.layout import Dataset
from express50.contract.stage import stages
from express50.dial.figures import footage_of
from express50.runner.executor import Pool
from express50.runner.runner import run_stage
from express50.runner.worker import core_seconds, peak_memory, reset_peak_memory

# Each stage's process imports this module, so it imports heavy benchmarks only where it uses them:
# their libraries would count for every stage.
PRESETS = ("draft", "standard")
EXPRESSIONS = ("neutral",)
SMALLER = "8x320x320,24x910x512"  # the demo's cameras; all cameras at 512 px


def record(out: Path, cameras: int, width: int, height: int) -> tuple[list[Path], Path]:
    """Record one moment unless it is there; returns captures and truth."""
    from benchmarks.demo import record_twin

    twin = {
        "subjects": 1, "cameras": cameras, "width": width, "height": height,
        "frames-per-expression": 4, "board-frames": 0,
    }  # fmt: skip
    record_twin(out, 2, twin, EXPRESSIONS, ("--give-calibration",))
    return sorted((out / "captures").iterdir()), out / "truth"


def run_alone(name: str, root: Path, preset: str) -> dict[str, float]:
    """Run a stage in this process; returns its core seconds and the process's peak memory."""
    stage = stages()[name]
    reset_peak_memory()
    summary = run_stage(
        stage, Dataset(root), resolve_config(stage, preset), pool=Pool(0), progress=False
    )
    failed = [outcome.reason for outcome in summary.outcomes if outcome.reason]
    if failed:
        raise RuntimeError(f"{name}: {failed[0]}")
    return {"core_seconds": round(core_seconds(), 2), "gib": round(peak_memory() / 2**30, 2)}


def measure_preset(captures: list[Path], truth: Path, root: Path, preset: str) -> dict:
    """Run every stage of the chain with a preset; returns costs by stage, their sums, errors."""
    from benchmarks.accuracy import measure_dataset

    shutil.rmtree(root, ignore_errors=True)
    dataset = Dataset(root)
    if prepare := stages()["ingest"].prepare:
        prepare(dataset, captures, False)
    costs = {}
    for name in stages():
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            costs[name] = pool.submit(run_alone, name, root, preset).result()
        print(f"{preset} {name}: {costs[name]}", file=sys.stderr, flush=True)
    return {
        "core_seconds_per_moment": round(sum(row["core_seconds"] for row in costs.values()), 1),
        "peak_memory_gib": max(row["gib"] for row in costs.values()),
        "stages": costs,
        "errors": measure_dataset(dataset, truth),
    }


def compare_plan(large: Dataset, smaller: list[Dataset]) -> dict:
    """Predict the processor seconds of a dataset's items from smaller ones, and compare."""
    known = list(stages().values())
    sizes = [pair for dataset in smaller for pair in measure_sizes(dataset, known)]
    rows = estimate(known, footage_of(large), sizes, 1)
    said = {row.stage: row.items * (row.seconds or 0.0) for row in rows}
    took = {name: sum(cost.seconds) for name, cost in measure(large, known).items()}
    total = sum(took.values())
    return {
        "items_core_seconds": round(total, 1),
        "plan_core_seconds": round(sum(said.values()), 1),
        "plan_off_percent": round(100 * (sum(said.values()) / total - 1), 1),
        "plan_by_stage": {name: [round(said[name], 1), round(took[name], 1)] for name in took},
    }


def plan_campaign(datasets: list[Dataset]) -> dict:
    """Estimate EXPRESS-50 from datasets of several sizes, the largest first."""
    known = list(stages().values())
    sizes = [pair for dataset in datasets for pair in measure_sizes(dataset, known)]
    target = target_of("express-50", {}, sizes[0][0])
    moments = target.subjects * target.expressions
    rows = estimate(known, target, sizes, 1)
    hours = {row.stage: row.core_hours or 0.0 for row in rows}
    total = {key: value for key, value in totals(rows).items() if key.startswith("core_hours")}
    return {key: round(value, 1) for key, value in total.items()} | {
        "core_seconds_per_moment": round(3600 * total["core_hours"] / moments, 1),
        "by_stage": {name: round(3600 * value / moments, 2) for name, value in hours.items()},
    }


def main(arguments: list[str] | None = None) -> int:
    """Record, measure and print."""
    from benchmarks.common import make_parser

    parser = make_parser("scale", __doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--cameras", type=int, default=24)
    parser.add_argument("--size", default="3840x2160", help="WIDTHxHEIGHT")
    parser.add_argument("--smaller", default=SMALLER, help="CAMERASxWIDTHxHEIGHT,...; may be empty")
    parser.add_argument("--presets", default=",".join(PRESETS))
    args = parser.parse_args(arguments)
    sizes = [f"{args.cameras}x{args.size}", *filter(None, args.smaller.split(","))]
    roots = [args.out if k == 0 else args.out / text for k, text in enumerate(sizes)]
    footage = [
        record(root / "twin", *map(int, text.split("x")))
        for root, text in zip(roots, sizes, strict=True)
    ]
    found: dict[str, dict] = {}
    for preset in args.presets.split(","):
        rows = [
            measure_preset(*paths, root / preset, preset)
            for root, paths in zip(roots, footage, strict=True)
        ]
        found[preset] = rows[0]
        if smaller := [Dataset(root / preset) for root in roots[1:]]:
            large = Dataset(roots[0] / preset)
            found[preset] |= compare_plan(large, smaller)
            found[preset]["express_50"] = plan_campaign([large, *smaller])
            found[preset]["smaller"] = dict(zip(sizes[1:], rows[1:], strict=True))
    print(json.dumps({"cameras": args.cameras, "size": args.size} | found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
