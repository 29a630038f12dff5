"""Measure the whole chain at real size: core seconds per moment, memory per worker, errors.

``python -m benchmarks.scale OUT`` records one moment (one expression of one person) with 24 cameras
of 3840 x 2160, without a board, and runs every stage with each preset, every stage in a process of
its own. ``--cameras`` and ``--size`` make smaller ones; the footage is recorded anew if they
change. What a stage does once per subject counts in full, as if the subject had one expression. The
last line printed is one JSON object: ``<preset>.core_seconds_per_moment``,
``<preset>.peak_memory_gib``, both also by stage, and the errors against the truth.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import shutil
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from benchmarks.accuracy import measure_dataset
from benchmarks.demo import record_twin
from express50.contract.config import resolve_config
from express50.contract.layout import Dataset
from express50.contract.stage import stages
from express50.runner.runner import run_stage
from express50.runner.worker import core_seconds

PRESETS = ("draft", "standard")
EXPRESSIONS = ("neutral",)


def run_alone(name: str, root: Path, preset: str) -> dict[str, float]:
    """Run a stage in this process; returns its core seconds and the process's peak memory."""
    stage = stages()[name]
    summary = run_stage(
        stage, Dataset(root), resolve_config(stage, preset), workers=0, progress=False
    )
    failed = [outcome.reason for outcome in summary.outcomes if outcome.reason]
    if failed:
        raise RuntimeError(f"{name}: {failed[0]}")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {"core_seconds": round(core_seconds(), 2), "gib": round(peak, 2)}


def measure_preset(captures: list[Path], truth: Path, root: Path, preset: str) -> dict:
    """Run every stage of the chain with a preset; returns costs by stage, their sums, errors."""
    shutil.rmtree(root, ignore_errors=True)
    dataset = Dataset(root)
    if prepare := stages()["ingest"].prepare:
        prepare(dataset, captures)
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


def main(arguments: list[str] | None = None) -> int:
    """Record, measure and print."""
    parser = argparse.ArgumentParser(prog="benchmarks.scale", description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--cameras", type=int, default=24)
    parser.add_argument("--size", default="3840x2160", help="WIDTHxHEIGHT")
    parser.add_argument("--presets", default=",".join(PRESETS))
    args = parser.parse_args(arguments)
    width, height = map(int, args.size.split("x"))
    twin = {
        "subjects": 1, "cameras": args.cameras, "width": width, "height": height,
        "frames-per-expression": 4, "board-frames": 0,
    }  # fmt: skip
    record_twin(args.out / "twin", 2, twin, EXPRESSIONS, ("--give-calibration",))
    captures = sorted((args.out / "twin" / "captures").iterdir())
    found = {
        preset: measure_preset(captures, args.out / "twin" / "truth", args.out / preset, preset)
        for preset in args.presets.split(",")
    }
    print(json.dumps({"cameras": args.cameras, "size": args.size} | found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
