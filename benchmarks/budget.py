"""Measure budgets: the time used, the error beside the best of a grid, and the error promised.

``python -m benchmarks.budget build/budget`` records twin captures, runs the chain for five budgets
from a minute to an hour and with every preset, and measures each run against the truth. ``--quick``
takes one person of two expressions, one pilot for all runs, and budgets for three points of the
front, in processor time, which means something on a busy machine too. ``--captures`` takes footage
without truth: errors are then differences from the most expensive run, and promises cannot be
checked.
A budget that ends early, or is refused although a fixed preset takes no longer, is a miss of 100 %
of its time, and keeps no promise. The last line printed is one JSON object.
"""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.common import make_parser
from benchmarks.demo import EXPRESSIONS, record_twin
from benchmarks.intervals_collect import peak_samples, row_samples
from benchmarks.truth import Truth
from express50.contract.config import PRESETS
from express50.contract.layout import Dataset
from express50.contract.stage import stages
from express50.dial.budget import parse_budget
from express50.dial.results import RESULTS, differences
from express50.runner.ledger import Ledger

TWIN = {"subjects": 3, "cameras": 8, "width": 320, "height": 320, "frames-per-expression": 6}
QUICK = {"subjects": 1, "cameras": 8, "width": 320, "height": 320, "frames-per-expression": 6}
BUDGETS = ("1m", "5m", "15m", "30m", "1h")
ALIKE = 1.02  # errors that differ by less are equal
# Stages whose samples hold the true errors of each result, as the stage states its own.
MAKERS = {
    "register": "mesh",
    "track": "track",
    "depth": "depth",
    "matte": "mattes",
    "align": "peaks",
}


@dataclass
class Run:
    """One run of the chain: what it was asked, took, promised and gave, and whether it ended."""

    name: str
    seconds: float
    budget: float | None
    expected: float | None
    settings: dict[str, str]
    promised: dict[str, dict]
    errors: dict[str, float]
    finished: bool = True


def main() -> None:
    """Run the benchmark."""
    parser = make_parser("budget", __doc__)
    parser.add_argument("out", type=Path, nargs="?", default=Path("build/budget"))
    parser.add_argument("--captures", type=Path, nargs="+", help="footage without truth")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    truth, captures = None, args.captures
    if captures is None:
        size, words = (QUICK, EXPRESSIONS[:2]) if args.quick else (TWIN, EXPRESSIONS)
        record_twin(args.out / "twin", args.workers, size, words)
        captures = sorted((args.out / "twin" / "captures").iterdir())
        truth = Truth(args.out / "twin" / "truth")
    workers = 0 if args.quick else args.workers
    tuned = args.out / "tuned"
    table = tune(tuned, captures, workers)
    budgets = quick_budgets(table) if args.quick else BUDGETS
    runs = [
        run_one(args.out, f"budget-{text}", captures, workers, ["--budget", text], args.quick)
        for text in budgets
    ]
    grid = [
        run_one(args.out, preset, captures, workers, ["--preset", preset], False)
        for preset in PRESETS[: 2 if args.quick else 3]
    ]
    measure_all(args.out, [*runs, *grid], truth)
    for run in [*runs, *grid]:
        print(f"{run.name}: {run.seconds:.0f} s {run.settings} {run.errors}", file=sys.stderr)
    print(json.dumps(figures(runs, grid, truth is not None) | {"core_time": args.quick}))


def tune(root: Path, captures: Sequence[Path], workers: int) -> dict:
    """Measure the front of the captures; returns its table."""
    front = root / "dial" / "front.json"
    if not front.is_file():
        command = ["tune", str(root), *map(str, captures), "--workers", str(workers)]
        express50(command)
    return json.loads(front.read_text())


def express50(arguments: Sequence[str]) -> int:
    """Run a command of the project; its output goes to standard error."""
    command = [sys.executable, "-m", "express50", *arguments]
    return subprocess.run(command, stdout=sys.stderr, check=False).returncode


def quick_budgets(table: Mapping) -> list[str]:
    """Choose processor times for three points of a front.

    They are the cheapest, the quickest that should be as good as the best preset, and the most
    expensive.
    """
    points = table["front"]
    wanted = ALIKE * min(point["worse"] for point in table["presets"].values())
    alike = next((point for point in points if point["worse"] <= wanted), points[-1])
    times = sorted({point["core_seconds"] for point in (points[0], alike, points[-1])})
    return [f"{1.15 * seconds / 3600:.4f}ch" for seconds in times]


def run_one(
    out: Path, name: str, captures: Sequence[Path], workers: int, options: list[str], pilot: bool
) -> Run:
    """Run the chain once, unless it has run; with ``pilot`` it need not measure itself."""
    dataset = Dataset(out / name)
    if not (dataset.root / "done.json").is_file():
        if pilot:
            (dataset.root / "dial").mkdir(parents=True, exist_ok=True)
            shutil.copy2(out / "tuned" / "dial" / "measured.json", dataset.root / "dial")
        started = time.monotonic()
        code = express50(
            ["run", str(dataset.root), *map(str, captures), "--workers", str(workers), *options]
        )
        done = {"code": code, "seconds": time.monotonic() - started}
        (dataset.root / "done.json").write_text(json.dumps(done))
    record = dataset.root / "dial" / "run.json"
    budget = parse_budget(options[1]).seconds if options[0] == "--budget" else None
    if not record.is_file():
        done = json.loads((dataset.root / "done.json").read_text())
        # Budgets without workers are of processor time, others of the clock's.
        seconds = done["seconds"] if workers else core_seconds(dataset)
        return Run(name, seconds, budget, None, {}, {}, {}, done["code"] == 0)
    row = json.loads(record.read_text())
    keys = ("spent", "seconds", "settings", "promised", "finished")
    spent, expected, settings, promised, finished = (row[key] for key in keys)
    return Run(name, spent, budget, expected, settings, promised, {}, finished)


def core_seconds(dataset: Dataset) -> float:
    """Sum up the processor time of a dataset's items; 0 if its run was refused."""
    if not dataset.ledger.is_file():
        return 0.0
    with Ledger(dataset.ledger, read_only=True) as ledger:
        return sum(r.core_seconds for name in stages() for r in ledger.read(name).values())


def measure_all(out: Path, runs: Sequence[Run], truth: Truth | None) -> None:
    """Measure every run against the truth, or against the most expensive of them."""
    runs = [run for run in runs if run.finished]
    if not runs:
        return
    best = Dataset(out / max(runs, key=lambda run: core_seconds(Dataset(out / run.name))).name)
    for run in runs:
        dataset = Dataset(out / run.name)
        if truth is not None:
            run.errors = true_errors(dataset, truth)
        elif dataset.root != best.root:
            rows = [differences(dataset, best, s, RESULTS) for s in dataset.subjects()]
            names = rows[0].keys()
            run.errors = {name: float(np.mean([row[name] for row in rows])) for name in names}


def true_errors(dataset: Dataset, truth: Truth) -> dict[str, float]:
    """Return the typical error of each result's items, in the measure that its stage states."""
    rows: dict[str, list[float]] = {}
    for sample in (*row_samples(dataset, truth), *peak_samples(dataset, truth)):
        typical = np.mean if sample.stage == "matte" else np.median
        rows.setdefault(MAKERS[sample.stage], []).append(float(typical(sample.errors)))
    return {name: float(np.median(values)) for name, values in rows.items()}


def figures(runs: Sequence[Run], grid: Sequence[Run], true: bool) -> dict:
    """Compute the figures of the issue from all runs; None if no run has any."""
    asked, everyone = runs, [run for run in (*runs, *grid) if run.finished]
    runs, grid = ([run for run in some if run.finished] for some in (runs, grid))
    scale = {}
    for name in MAKERS.values():
        found = [run.errors[name] for run in everyone if name in run.errors]
        if size := float(np.median(found) or max(found)) if found else 0.0:  # most peaks are right
            scale[name] = size

    def final(run: Run) -> float:
        return float(np.mean([run.errors.get(name, 0.0) / size for name, size in scale.items()]))

    regrets = []
    for run in runs:
        fitting = [r for r in everyone if r.seconds <= (run.budget or math.inf) * 1.02]
        best = min(map(final, fitting), default=final(run))
        regrets.append(100 * (final(run) / max(best, 1e-9) - 1))
    kept = [
        run.finished and p["low"] <= run.errors.get(name, math.inf) <= p["high"]
        for run in asked for name, p in run.promised.items() if p["stated"] and true
    ]  # fmt: skip
    over = [missed(run, everyone) for run in asked if run.budget]
    off = [100 * abs(r.seconds / r.expected - 1) for r in runs if r.expected]
    return {
        "time_miss_percent": round(float(np.percentile(over, 90)), 1) if over else None,
        "forecast_miss_percent": round(float(np.percentile(off, 90)), 1) if off else None,
        "regret_percent": round(max(regrets), 1) if regrets else None,
        "promise_kept_percent": round(100 * float(np.mean(kept)), 1) if kept else None,
        "promises": len(kept),
        "time_saved_percent": saved(runs, grid, final) if grid else None,
        "unfinished": [run.name for run in asked if not run.finished],
        "runs": [vars(run) for run in (*asked, *grid)],
    }


def missed(run: Run, everyone: Sequence[Run]) -> float:
    """Return by how many percent a budgeted run missed its time; 100 where it made too little.

    A budget is refused before the run starts if nothing fits into it. That is right unless some
    finished run took no longer.
    """
    budget = run.budget or math.inf
    if run.finished:
        return 100 * max(0.0, run.seconds / budget - 1)
    begun = bool(run.settings)
    return 100.0 if begun or any(other.seconds <= budget for other in everyone) else 0.0


def saved(runs: Sequence[Run], grid: Sequence[Run], final) -> float | None:  # noqa: ANN001
    """Return the time that the dial saves at the error of the best preset; None if it has not.

    The best preset is the one with the least error, the quicker of two that differ by under 2 %.
    """
    least = min(map(final, grid))
    best = min((r for r in grid if final(r) <= ALIKE * least), key=lambda run: run.seconds)
    alike = [run.seconds for run in runs if final(run) <= ALIKE * final(best)]
    return round(100 * (1 - min(alike) / best.seconds), 1) if alike else None


if __name__ == "__main__":
    main()
