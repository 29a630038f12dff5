"""``express50 plan`` scales measured datasets' receipts to the cost of a capture campaign.

Seconds and bytes per item are modelled as a constant plus a term proportional to the product of the
sizes that the stage's `Growth` names. Datasets of two sizes separate the two terms, and every
figure has an interval. Part of the memory is constant, so memory is given as measured, which is a
lower bound.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.filesize import decimal

from express50.console import (
    add_command,
    answer,
    count,
    format_table,
    number,
    picture_size,
    stdout_to_stderr,
)
from express50.contract.config import PRESETS, made_with, resolve_config
from express50.contract.layout import Dataset, existing_dataset
from express50.contract.stage import Stage, stages
from express50.dial.figures import Cost, Footage, dial_dir, footage_of, read_measured
from express50.errors import rounded
from express50.files.digests import files_of, text_digest
from express50.runner.ledger import Ledger
from express50.runner.publish import size_of

SIZES = {  # options, and their names in `Footage`
    "subjects": "subjects", "expressions": "expressions", "cameras": "views",
    "frames_per_expression": "frames_per_expression",
}  # fmt: skip
# Campaigns of the papers: EXPRESS-50, and RenderMe-360 as it was used beside it (280 of its people,
# 12 expressions, 60 cameras). Clips are as long as the measured dataset's.
TARGETS: dict[str, dict[str, float]] = {
    "express-50": {
        "subjects": 50, "expressions": 60, "views": 24, "pixels": 3840 * 2160, "shape": 9 / 16
    },
    "renderme-360": {
        "subjects": 280, "expressions": 12, "views": 60, "pixels": 2448 * 2048, "shape": 2048 / 2448
    },
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What one stage cost in a dataset."""

    seconds: tuple[float, ...]  # per item, of processors if receipts hold them, else of the clock
    bytes: float  # per item
    memory: float  # most of all items
    preset: str


@dataclass(frozen=True, kw_only=True)
class Row:
    """Holds the estimate of one stage; if there is no estimate, ``why`` says the reason."""

    stage: str
    items: int
    seconds: float | None = None
    core_hours: float | None = None
    core_hours_low: float | None = None
    core_hours_high: float | None = None
    sizes: int = 0
    days: float | None = None
    disk: float | None = None
    disk_low: float | None = None
    disk_high: float | None = None
    memory: float | None = None
    preset: str = ""
    how: str = ""
    why: str = ""


def add_commands(subparsers: Any) -> None:
    """Add the ``plan`` command."""
    words = "estimate what a campaign costs, from measured datasets"
    parser = add_command(
        subparsers, "plan", run_plan, words,
        description="Scale the time and disk space that every stage took on a dataset to the size "
        "of a campaign. Every figure comes from receipts or from 'express50 tune' on this "
        "machine; stages that were not run are n/a. A second dataset of another size "
        "(--also) separates costs that grow with the footage from constant ones.",
        example="express50 plan DATASET --also OTHER --target express-50 --workers 32",
    )  # fmt: skip
    add = parser.add_argument
    words = "another measured dataset, of another size; may be repeated"
    add("--also", type=Path, action="append", default=[], metavar="DATASET", help=words)
    add("--target", choices=list(TARGETS), help="plan a campaign as large as this one")
    for name in SIZES:
        words = f"{name.replace('_', ' ')} of the campaign (default: --target's, else DATASET's)"
        add(f"--{name.replace('_', '-')}", type=number(1), metavar="N", help=words)
    words = "pictures of the campaign, pixels (default: --target's, else DATASET's)"
    add("--size", type=picture_size, metavar="WIDTHxHEIGHT", help=words)
    words = "cores to use (default: 1)"
    add("--workers", type=number(1), default=1, metavar="N", help=words)


def run_plan(args: argparse.Namespace) -> int:
    """Print one row per stage, and the sum."""
    dataset = Dataset(args.dataset)
    given = {key: getattr(args, option) for option, key in SIZES.items()}
    if args.size is not None:
        given |= {"pixels": math.prod(args.size), "shape": min(args.size) / max(args.size)}
    sizes = {key: size for key, size in given.items() if size is not None}
    with stdout_to_stderr():
        known = list(stages().values())
        datasets = [dataset, *map(Dataset, args.also)]
        measured = [pair for one in datasets for pair in measure_sizes(one, known)]
    footage = measured[0][0]
    target = target_of(args.target, sizes, footage)
    rows = estimate(known, target, measured, args.workers)
    total = totals(rows)
    replaced = size_of(dataset.replaced_dir)[1]
    data = {
        "target": vars(target), "measured": [vars(f) for f, _ in measured], "total": total,
        "workers": args.workers, "stages": [vars(row) for row in rows], "replaced": replaced,
    }  # fmt: skip
    lines = [
        f"target   {args.target or 'as given'}: {_words(target)}",
        *dict.fromkeys(f"measured {_words(size)}" for size, _ in measured),
        *_table(rows, total, args.workers),
        "core hours, disk: with 90 % intervals; part of a stage's time or disk may be constant, "
        "which only a second dataset of another size can show (--also DATASET)",
        "s per item: of one core; stages one after the other, no item split over workers",
        "peak memory: as measured; more footage may need more",
        f"disk: without replaced outputs ({decimal(replaced)} here); stages keep two per item "
        "while 2 GB are free, and 'express50 prune' deletes them",
    ]
    if total["not_measured"]:
        lines.append(
            f"the sum leaves out what was not measured: {', '.join(total['not_measured'])}"
        )
    return answer(args, data, *lines)


def _table(rows: Sequence[Row], total: Mapping[str, Any], workers: int) -> Iterator[str]:
    columns = ["stage", "items", "s per item", "core hours", f"days on {workers}", "disk"]
    columns += ["peak memory", "preset", "sizes", "times what was measured"]
    cells = []
    for row in rows:
        figures, measured = ["n/a"] * 5, ["", "0", row.why]
        if not row.why:
            hours = _hours(row.core_hours, row.core_hours_low, row.core_hours_high)
            figures = [f"{row.seconds:.1f}", hours, f"{row.days:.2f}"]
            figures += [_disk(vars(row)), f">= {decimal(int(row.memory or 0))}"]
            measured = [row.preset, str(row.sizes), row.how]
        cells.append([row.stage, str(row.items), *figures, *measured])
    hours = _hours(total["core_hours"], total["core_hours_low"], total["core_hours_high"])
    days = f"{total['days']:.2f}"
    cells.append(["sum", "", "", hours, days, _disk(total), "", "", "", ""])
    return format_table(columns, cells)


def _hours(value: float | None, low: float | None, high: float | None) -> str:
    # Of one precision, so that no value seems to lie outside its interval.
    return "{} ({} to {})".format(*(rounded(hours or 0) for hours in (value, low, high)))


def _disk(figures: Mapping[str, Any]) -> str:
    value, low, high = (decimal(int(figures[f"disk{end}"] or 0)) for end in ("", "_low", "_high"))
    return f"{value} ({low} to {high})"


def _words(footage: Footage) -> str:
    return (
        f"{count(footage.subjects, 'subject')} x {count(footage.expressions, 'expression')} x "
        f"{count(footage.views, 'camera')} of {footage.pixels / 1e6:.3g} megapixels, "
        f"{count(round(footage.frames), 'frame')} per camera"
    )


def measure_sizes(
    dataset: Dataset, known: Sequence[Stage]
) -> list[tuple[Footage, dict[str, Measured]]]:
    """Return what stages cost at each measured size: first from the run, then from ``tune``.

    Raises:
        ConfigError: the folder is not a dataset.
        StageError: nothing is ingested.
    """
    figures = read_measured(dial_dir(dataset) / "measured.json")
    trials = figures.trials if figures else []
    if not trials or dataset.subjects():
        costs = measure(dataset, known)  # first: it says that a folder is not a dataset
        found = [(footage_of(dataset), costs)]
    else:
        seen = trials[0]
        # A run without a budget has standard settings, which do not reduce pictures.
        found = [(replace(seen.footage, expressions=seen.scripted, side=0.0), {})]
    counted: set[tuple[str, Cost]] = set()
    for trial in trials:  # each states, too, what the stages cost that it took from another
        new = {name: cost for name, cost in trial.costs.items() if (name, cost) not in counted}
        counted |= new.items()
        table = {
            name: Measured(
                seconds=(cost.core_seconds,), bytes=cost.bytes, memory=cost.memory,
                preset=trial.settings[name],
            )
            for name, cost in new.items()
        }  # fmt: skip
        found.append((trial.footage, table))
    return found


def measure(dataset: Dataset, known: Sequence[Stage]) -> dict[str, Measured]:
    """Return what each stage that ran cost, by receipts and files; ConfigError without a ledger."""
    existing_dataset(dataset.root)
    found = {}
    with Ledger(dataset.ledger, read_only=True) as ledger:
        for stage in known:
            done = [r for r in ledger.read(stage.name).values() if r.status == "done"]
            folders = [dataset.item_dir(stage.name, receipt.item) for receipt in done]
            if done:
                size = sum(path.stat().st_size for one in folders for path in files_of(one))
                found[stage.name] = Measured(
                    seconds=tuple(r.core_seconds or r.seconds for r in done),
                    bytes=size / len(done),
                    memory=max(r.peak_memory for r in done),
                    preset=preset_of(dataset, stage),
                )
    return found


def preset_of(dataset: Dataset, stage: Stage) -> str:
    """Return the preset that a stage last ran with, or ``own`` and a digest of its settings."""
    presets = {preset: resolve_config(stage, preset) for preset in ("standard", *PRESETS)}
    path = dataset.config_file(stage.name)
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    return made_with(path, stage, presets) or f"own {text_digest(text)[:6]}"


def target_of(name: str | None, sizes: Mapping[str, float], measured: Footage) -> Footage:
    """Return the campaign to estimate: given sizes first, then the named campaign's, then measured.

    `name` is a key of `TARGETS`. Sizes have their names in `Footage`, or ``frames_per_expression``.
    """
    kept = ("subjects", "expressions", "views", "pixels", "shape")
    values = {key: getattr(measured, key) for key in kept}
    values |= TARGETS.get(name or "", {}) | dict(sizes)
    each = measured.frames / max(measured.expressions, 1)
    each = values.pop("frames_per_expression", each)
    return Footage(
        **values, frames=each * values["expressions"], side=measured.side, every=measured.every
    )


def estimate(
    known: Sequence[Stage],
    target: Footage,
    measured: Sequence[tuple[Footage, Mapping[str, Measured]]],
    workers: int,
) -> list[Row]:
    """Estimate one row per stage for a campaign, from what each cost on measured footage.

    Workers are processes of one core each. Only datasets of the first one's preset count.
    """
    # Imported here, because NumPy would slow every command.
    from express50.dial.choice import MeasuredSize, forecast

    rows = []
    for stage in known:
        growth = stage.growth
        items = max(1, round(target.items(growth)))
        runs = [(footage, table[stage.name]) for footage, table in measured if stage.name in table]
        if not runs:
            rows.append(Row(stage=stage.name, items=items, why="was not run"))
            continue
        # A pilot tried several settings; a run would use standard.
        footage, cost = next((run for run in runs if run[1].preset == "standard"), runs[0])
        if stage.name in measured[0][1]:
            footage, cost = runs[0]
        alike = [(f, c) for f, c in runs if c.preset == cost.preset]
        samples = [MeasuredSize(f.time(growth), c.seconds) for f, c in alike]
        item = forecast(samples, target.time(growth))
        ratio = target.time(growth) / footage.time(growth)
        kept = [MeasuredSize(f.work(growth.disk), [c.bytes]) for f, c in alike]
        # The law of seconds holds for bytes too: a surface is as large whatever the pictures.
        disk = forecast(kept, target.work(growth.disk))
        rows.append(
            Row(
                stage=stage.name,
                items=items,
                seconds=item.value,
                core_hours=items * item.value / 3600,
                core_hours_low=items * item.low / 3600,
                core_hours_high=items * item.high / 3600,
                sizes=item.sizes,
                days=items * item.value / 86400 / min(workers, items),
                disk=items * disk.value,
                disk_low=items * disk.low,
                disk_high=items * disk.high,
                memory=max(c.memory for _, c in alike),
                preset=cost.preset,
                how=f"{' x '.join(growth.time) or 'constant'} = {rounded(ratio, 4)}",
            )
        )
    return rows


def totals(rows: Sequence[Row]) -> dict[str, Any]:
    """Add up the stages that were measured, and list those that were not."""
    known = [row for row in rows if not row.why]
    ends = ("", "_low", "_high")
    names = ["days", *(name + end for name in ("core_hours", "disk") for end in ends)]
    return {name: sum(getattr(row, name) or 0.0 for row in known) for name in names} | {
        "presets": dict(Counter(row.preset for row in known)),
        "not_measured": [row.stage for row in rows if row.why],
    }
