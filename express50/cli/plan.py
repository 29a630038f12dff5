"""``express50 plan``: the cost of a capture campaign, estimated from measured datasets."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from express50.console import OK, format_table, say, say_json, stdout_to_stderr
from express50.contract.config import PRESETS
from express50.contract.extensions import stages
from express50.contract.layout import Dataset
from express50.dataset.plan import (
    TARGETS,
    Footage,
    Row,
    estimate,
    footage_of,
    measure,
    target_of,
    totals,
)
from express50.errors import ConfigError

SIZES = ("subjects", "expressions", "cameras", "frames_per_expression")


def add_commands(subparsers: Any) -> None:
    """Add the ``plan`` command."""
    parser = subparsers.add_parser(
        "plan",
        help="what a campaign costs, from a measured dataset's receipts",
        description="Scales what every stage of a dataset took to the size of a campaign: linearly "
        "in what its items grow with, or, given a second dataset of another size, with a fitted "
        "exponent. Every figure is from receipts of this machine; what was not run is n/a.",
        epilog="example: express50 plan DATASET --target express-50 --workers 32",
    )
    parser.add_argument("dataset", type=Path, metavar="DATASET", help="a dataset that was made")
    parser.add_argument("second", type=Path, nargs="?", metavar="SECOND", help="of another size")
    parser.add_argument("--target", choices=list(TARGETS), help="a named campaign")
    for name in SIZES:
        flag = f"--{name.replace('_', '-')}"
        parser.add_argument(flag, type=int, metavar="N", help="of the target; else as measured")
    parser.add_argument("--size", metavar="WxH", help="pixels of the target's cameras")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="cores (default 1)")
    parser.add_argument("--preset", choices=PRESETS, help="leave out what ran with another")
    parser.add_argument("--json", action="store_true", help="print as JSON")
    parser.set_defaults(handler=run_plan)


def run_plan(args: argparse.Namespace) -> int:
    """Print a row a stage, and the sum."""
    if args.workers < 1:
        raise ConfigError(f"--workers {args.workers}: expected at least 1")
    datasets = [Dataset(path) for path in (args.dataset, args.second) if path is not None]
    sizes = {name: getattr(args, name) for name in SIZES if getattr(args, name) is not None}
    if "cameras" in sizes:
        sizes["views"] = sizes.pop("cameras")
    if args.size is not None:
        sizes["pixels"] = _pixels(args.size)
    with stdout_to_stderr():
        known = list(stages().values())
        measured = [measure(dataset, known) for dataset in datasets]
        target = target_of(args.target, sizes, footage_of(datasets[0]))
    rows = estimate(known, target, measured, args.workers, args.preset)
    if args.json:
        footage = [vars(footage_of(dataset)) for dataset in datasets]
        say_json(
            {"target": vars(target), "measured": footage, "workers": args.workers}
            | {"stages": [vars(row) for row in rows], "total": totals(rows)}
        )
    else:
        say(*_lines(args, datasets, target, rows))
    return OK


def _pixels(text: str) -> int:
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise ConfigError(f"--size {text!r}: expected WIDTHxHEIGHT such as 3840x2160") from None
    return width * height


def _lines(
    args: argparse.Namespace, datasets: list[Dataset], target: Footage, rows: list[Row]
) -> list[str]:
    head = [f"target   {args.target or 'as given'}: {_words(target)}"]
    head += [f"measured {dataset.root}: {_words(footage_of(dataset))}" for dataset in datasets]
    columns = ["stage", "items", "s an item", "core hours", f"days on {args.workers}"]
    columns += ["disk", "peak memory", "preset", "times what was measured"]
    cells = [_cells(row) for row in rows]
    total = totals(rows)
    cells.append(
        ["sum", "", "", f"{total['core_hours']:.1f}", f"{total['days']:.2f}", _size(total["disk"])]
        + [""] * 3
    )
    notes = ["s an item: of one core; stages one after the other, no item split over workers"]
    if any(row.memory is not None and not row.memory_grows for row in rows):
        notes.append(">= memory as measured; how it grows, a second dataset of another size tells")
    if total["not_measured"]:
        notes.append(f"the sum lacks {', '.join(total['not_measured'])}")
    return [*head, *format_table(columns, cells), *notes]


def _cells(row: Row) -> list[str]:
    if row.why:
        return [row.stage, str(row.items), *["n/a"] * 5, "", row.why]
    return [
        row.stage,
        str(row.items),
        f"{row.seconds:.1f}",
        f"{row.core_hours:.1f}",
        f"{row.days:.2f}",
        _size(row.disk or 0.0),
        ">= " * (not row.memory_grows) + _size(row.memory or 0.0),
        row.preset,
        row.how,
    ]


def _words(footage: Footage) -> str:
    sizes = {name: f"{value:.6g}" for name, value in vars(footage).items()}
    return (
        f"{sizes['subjects']} subjects x {sizes['expressions']} expressions x {sizes['views']} "
        f"cameras of {footage.pixels / 1e6:.3g} megapixels, {sizes['frames']} frames a camera"
    )


def _size(count: float) -> str:
    """Bytes in GB, or MB where these are few."""
    return f"{count / 1e9:,.1f} GB" if count >= 1e9 else f"{count / 1e6:,.1f} MB"
