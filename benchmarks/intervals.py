"""Measure how often the bounds hold that stages state about their own errors.

``python -m benchmarks.intervals [--work DIR] [--conditions ...] [--made]`` records test subjects of
the digital twin under the conditions of ``benchmarks.intervals_rows``, runs the chain, and compares
the stated bounds with the truth: ``coverage_percent`` of a stage and condition is the share of
elements (pixels of depth, pixels about a matte's outline, vertices, cameras, peaks) whose error is
within its bound, items weighted alike; 90 is meant. Errors of one person or rig go together, so
``between`` is the interval that holds a row's true coverage nine times in ten, from how much people
differ in all rows of the stage; ``rows_off`` lie outside of 88 to 92 with it. ``items_inside``
counts the items whose error lies in the interval of their ``expected_error``. ``depth.ause`` is the
sparsification error of depth (0 is ideal, Ilg et al. 2018) over all pixels, ``_skin`` over those of
bare skin.
What is made is kept in DIR and taken up again; ``--made`` takes only that. ``--fit`` makes the same
of other subjects, and writes ``express50/error_models.json`` from it; raise the versions of the
stages then. ``--fit items`` fits the intervals of items alone. The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from scipy import stats

from benchmarks.common import make_parser
from benchmarks.intervals_collect import (
    Figures,
    Sample,
    peak_samples,
    row_samples,
    sampled,
    with_tracked,
)
from benchmarks.intervals_fit import NOMINAL, ause, fit_items, fit_model
from benchmarks.intervals_rows import ALIGN_NOISE, CONDITIONS, make_peaks, make_row
from benchmarks.truth import Truth
from express50.contract.layout import Dataset
from express50.contract.stage import Unit
from express50.error_model import FILE, ErrorModel, error_bounds, error_models, item_error
from express50.errors import CalibrationError
from express50.files.atomic import dump_json
from express50.rigs.world_frame import meeting_point
from pipelines.calibrate.board_rig import solve_rig
from pipelines.calibrate.uncertainty import camera_errors, head_points, state_uncertainty
from tests.pipelines.board_rigs import POINTS, board_motion, make_rig, observe, sizes_of

UNITS: dict[str, Unit] = {
    "calibrate": "mm",
    "align": "frames",
    "matte": "alpha",
    "track": "mm",
    "depth": "mm",
    "register": "mm",
}
FIT, TEST = tuple(range(61, 69)), (71, 72, 73, 74)  # subjects
FIT_RIGS, TEST_RIGS = range(10), range(100, 110)  # seeds of simulated rigs
FIT_PEAKS, TEST_PEAKS = ((81, 82), (83,)), ((91, 92), (93,))  # subjects per noise of ALIGN_NOISE
BAR = 88.0, 92.0  # percent
# Cameras, focal length in pixels, distance in metres, noise of corners in pixels.
RIGS: dict[str, tuple[int, float, float, float]] = {
    "2 views": (2, 900.0, 1.1, 0.1),
    "4 views": (4, 900.0, 1.1, 0.1),
    "8 views": (8, 900.0, 1.1, 0.1),
    "noise": (4, 900.0, 1.1, 0.6),
    "focal length 400 px": (4, 400.0, 0.6, 0.1),
    "focal length 2,500 px": (4, 2500.0, 3.1, 0.1),
    "focal length 20,000 px": (4, 20000.0, 24.0, 0.1),
}
BOARDS = 24
Row = tuple[str, Sample]


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the rows, and fit or measure."""
    options = parse(arguments)
    began = time.process_time()
    rows = list(samples(options))
    if options.fit:
        write_models(rows, options.fit)
        return 0
    figures = measure(rows)
    figures["cpu_seconds"] = round(time.process_time() - began)
    print(json.dumps({"benchmark": "intervals"} | figures))
    return 0


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser("intervals", __doc__)
    parser.add_argument("--work", type=Path, default=Path("build/intervals"))
    names = [one.name for one in CONDITIONS]
    parser.add_argument("--conditions", nargs="*", choices=names, metavar="NAME",
                        default=[one.name for one in CONDITIONS if not one.costly])  # fmt: skip
    parser.add_argument(
        "--subjects", nargs="*", type=int, help="numbers; default: those not fitted"
    )
    parser.add_argument("--made", action="store_true", help="only rows that are made already")
    parser.add_argument("--fit", nargs="?", const="all", choices=("all", "items"),
                        help="fit the constants, on other subjects")  # fmt: skip
    options = parser.parse_args(arguments)
    mine, others = (FIT, TEST) if options.fit else (TEST, FIT)
    options.subjects = options.subjects or list(mine)
    if set(options.subjects) & set(others):
        parser.error(f"--subjects: {others} are the other side's; never fit and test on the same")
    return options


def samples(options: argparse.Namespace) -> Iterator[Row]:
    """Yield condition and sample of every stage, from rows that are made where they are not."""
    root = options.work
    chosen = [one for one in CONDITIONS if one.name in options.conditions]
    for number in options.subjects:
        for condition in chosen:
            subject = f"S{number:03d}"
            dataset = Dataset(root / "rows" / condition.row(subject))
            if options.made:
                if not dataset.stage_dir("register").is_dir():
                    continue
                truth = Truth(root / "films" / condition.film(subject) / "truth")
            else:
                dataset, truth = make_row(condition, number, root)
            print(f"{condition.name}, {subject}", file=sys.stderr, flush=True)
            yield from ((condition.name, sample) for sample in row_samples(dataset, truth))
    groups = FIT_PEAKS if options.fit else TEST_PEAKS
    for (name, noise), numbers in zip(ALIGN_NOISE.items(), groups, strict=True):
        folder = root / "peaks" / f"{noise}-{numbers[0]}"
        if not options.made:
            make_peaks(noise, numbers, root)
        elif not (folder / "dataset" / "align").is_dir():
            continue
        dataset, truth = Dataset(folder / "dataset"), Truth(folder / "twin" / "truth")
        yield from ((name, sample) for sample in peak_samples(dataset, truth))
    yield from rig_samples(FIT_RIGS if options.fit else TEST_RIGS)


def measure(rows: Sequence[Row]) -> dict:
    """Return the coverage per stage and condition, and depth's sparsification error."""
    models = error_models()
    table: dict[str, dict[str, dict]] = {stage: {} for stage in UNITS}
    for stage, conditions in table.items():
        mine = [(name, sample) for name, sample in rows if sample.stage == stage]
        for name in dict.fromkeys(name for name, _ in mine):
            found = [with_tracked(s, models["track"]) for n, s in mine if n == name]
            conditions[name] = coverage(found)
            if stage == "depth":
                conditions[name]["ause"] = sparsification(found)["depth.ause"]
        for name, pair in spread({n: row.pop("by_person") for n, row in conditions.items()}):
            conditions[name]["between"] = pair
    every = {
        f"{stage}, {name}": row for stage, rows_ in table.items() for name, row in rows_.items()
    }
    shares = [row["coverage_percent"] for row in every.values()]
    depth = [sample for _, sample in rows if sample.stage == "depth"]
    return {
        "coverage_min_percent": min(shares, default=None),
        "coverage_max_percent": max(shares, default=None),
        "rows_off": [
            name
            for name, row in every.items()
            if row["between"] and (row["between"][1] < BAR[0] or row["between"][0] > BAR[1])
        ],
        "coverage_percent_by_stage": {
            stage: mean([row["coverage_percent"] for row in conditions.values()])
            for stage, conditions in table.items()
        },
        "items_inside_percent_by_stage": {
            stage: round(
                100
                * sum(row["items_inside"] for row in conditions.values())
                / max(sum(row["items"] for row in conditions.values()), 1),
                1,
            )
            if conditions
            else None
            for stage, conditions in table.items()
        },
        **sparsification(depth),
        "rows": table,
        "not_run_through_the_chain": [
            one.name
            for one in CONDITIONS
            if one.name not in {name for name, sample in rows if sample.stage == "matte"}
        ],
        "not_measured": {
            "focal lengths under 310 px": "a head does not fit the twin's picture",
            "grmm": "it states no interval",
        },
    }


def coverage(found: Sequence[Sample]) -> dict:
    """Return how often the bounds of a condition's items held."""
    shares: dict[str, list[float]] = {}
    inside = 0
    for sample in found:
        bounds = error_bounds(sample.stage, sample.figures, sample.shared)
        share = 100 * float(np.mean(sample.errors <= bounds.bound))
        shares.setdefault(sample.item.split("/")[0], []).append(share)
        true, expected = item_error(sample.errors, UNITS[sample.stage]), bounds.expected
        inside += expected is not None and expected.low <= true <= expected.high
    return {
        "coverage_percent": round(float(np.mean(sum(shares.values(), []))), 1),
        "by_person": [float(np.mean(own)) for own in shares.values()],
        "items": len(found),
        "items_inside": int(inside),
        "error": mean([item_error(s.errors, UNITS[s.stage]) for s in found]),
        "unit": UNITS[found[0].stage],
    }


def spread(shares: Mapping[str, Sequence[float]]) -> Iterator[tuple[str, list[float] | None]]:
    """Yield each condition and the ends of its coverage's interval, from shares of people.

    People of few conditions say little of how much they differ, so the variance is that of all;
    None if no condition has two people.
    """
    free = sum(len(own) - 1 for own in shares.values())
    squares = sum(float(np.var(own)) * len(own) for own in shares.values())
    for name, own in shares.items():
        if not free:
            yield name, None
            continue
        reach = stats.t.ppf((1 + NOMINAL) / 2, free) * np.sqrt(squares / free / len(own))
        ends = np.mean(own) + reach * np.array([-1, 1])
        yield name, [round(float(end), 1) for end in np.clip(ends, 0, 100)]


def sparsification(depth: Sequence[Sample]) -> dict:
    """Return the mean sparsification errors of depth's items."""
    keys = ("depth.ause", "depth.ause_skin")
    rows = []
    for sample in depth:
        doubt, bare = error_bounds("depth", sample.figures, sample.shared).bound, sample.skin
        skin = ause(sample.errors[bare], doubt[bare]) if bare.any() else np.nan
        rows.append([ause(sample.errors, doubt), skin])
    if not rows:
        return dict.fromkeys(keys)
    return {k: round(float(v), 3) for k, v in zip(keys, np.nanmean(rows, axis=0), strict=True)}


def write_models(rows: Sequence[Row], what: str) -> None:
    """Fit and write every stage's constants, ``all`` or those of ``items``.

    Stages without samples keep theirs.
    """
    former = json.loads(FILE.read_text())
    shipped = error_models()
    models: dict[str, ErrorModel] = {}
    for stage, unit in UNITS.items():
        mine = [sample for _, sample in rows if sample.stage == stage]
        if stage == "register" and "track" in models:
            mine = [with_tracked(sample, models["track"]) for sample in mine]
        if mine and what == "items":
            models[stage] = fit_items(shipped[stage], mine)
        elif mine:
            models[stage] = fit_model(mine, unit)
    data = {
        stage: {
            "items": sum(sample.stage == stage for _, sample in rows),
            "conditions": list(dict.fromkeys(n for n, s in rows if s.stage == stage)),
            "subjects": sorted({s.item.split("/")[0] for _, s in rows if s.stage == stage})
            if stage != "calibrate"
            else f"simulated rigs, seeds {FIT_RIGS.start} to {FIT_RIGS.stop - 1}",
        }
        for stage in models
    }
    content = former | {
        "stages": former["stages"] | {k: _rounded(asdict(model)) for k, model in models.items()}
    }
    for key in ("fitted_on", "items_fitted_on") if what == "all" else ("items_fitted_on",):
        content[key] = former.get(key, {}) | data
    FILE.write_bytes(dump_json(content))
    error_models.cache_clear()
    print(f"wrote {FILE.name}: {', '.join(models)}", file=sys.stderr)


def _rounded(row: dict) -> dict:
    return {
        key: np.round(value, 4).tolist() if key not in ("unit", "features") else value
        for key, value in row.items()
    }


def mean(values: Sequence[float]) -> float | None:
    """Return the mean to four digits; None of nothing."""
    return float(f"{np.mean(values):.4g}") if len(values) else None


def rig_samples(seeds: range) -> Iterator[tuple[str, Sample]]:
    """Yield the condition and the sample of every simulated rig; one that fails is left out."""
    for name, (count, focal, distance, noise) in RIGS.items():
        span = 150.0 if count > 2 else 40.0
        rig = make_rig(count, focal, distance=distance, span_deg=span)
        for seed in seeds:
            corners = observe(rig, board_motion(BOARDS, seed, span), noise, seed)
            try:
                solution = solve_rig(corners, POINTS, sizes_of(rig), "OPENCV")
            except CalibrationError:
                continue
            stated = state_uncertainty(solution, POINTS)
            if not stated:
                continue
            true = {n: rig[n] for n in solution.cameras}
            off = camera_errors(solution.cameras, true, head_points() + meeting_point(true))
            names = sorted(stated)
            figures: Figures = {"stated_mm": np.array([stated[n].mm for n in names])}
            scale = np.array([stated[n].mm / stated[n].px for n in names])
            errors = scale * [off[n] for n in names]
            yield name, sampled("calibrate", f"{name} {seed}", [figures], [errors])


if __name__ == "__main__":
    sys.exit(main())
