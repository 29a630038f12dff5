"""Sweep the presets of every measured stage: error against seconds, into docs/TRADEOFFS.md.

``python -m benchmarks.tradeoff`` works on the demo's twin dataset (``make demo`` first). Each stage
is run with each preset over the same upstream outputs, and measured against the truth.
"""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path

from benchmarks import accuracy
from benchmarks.common import make_parser, replace_section
from benchmarks.truth import Truth
from express50.contract.config import PRESETS
from express50.contract.layout import Dataset
from express50.contract.stage import with_required
from express50.files.text import markdown_table
from express50.runner.worker import core_seconds
from pipelines.stages import STAGES

SECTION = "Presets of the stages"
MEASURES = {
    "calibrate": (accuracy.measure_calibrate, "translation_error_mm_max"),
    "align": (accuracy.measure_align, "peak_error_frames_mean"),
    "matte": (accuracy.measure_matte, "mae"),
    "track": (accuracy.measure_track, "vertex_rmse_mm"),
    "depth": (accuracy.measure_depth, "abs_error_mm_median"),
}
WORDS = {
    "translation_error_mm_max": "worst camera's position, mm",
    "peak_error_frames_mean": "mean distance from the true peak, frames",
    "mae": "mean absolute error of alpha",
    "vertex_rmse_mm": "vertex RMSE, mm",
    "abs_error_mm_median": "median absolute error, mm",
}


def main() -> None:
    """Run the sweep."""
    parser = make_parser("tradeoff", __doc__)
    parser.add_argument("--base", type=Path, default=Path("build/demo"))
    parser.add_argument("--out", type=Path, default=Path("build/tradeoff"))
    parser.add_argument("--doc", type=Path, default=Path("docs/TRADEOFFS.md"))
    parser.add_argument("--stages", nargs="+", default=list(MEASURES), choices=list(MEASURES))
    args = parser.parse_args()
    base = Dataset(args.base / "data" / "demo")
    truth = Truth(args.base / "twin" / "truth")
    if not base.captures_file.is_file():
        sys.exit(f"{base.root}: no demo dataset; run 'make demo' first")
    rows = [
        sweep_one(base, truth, stage, preset, args.out)
        for stage in args.stages
        for preset in presets_of(stage)
    ]
    rows = [*rows_of_others(args.doc, args.stages), *rows]
    rows.sort(key=lambda row: list(MEASURES).index(row["stage"]))
    write_csv(rows, args.out / "tradeoff.csv")
    plot(rows, args.doc.with_name("tradeoffs.png"))
    replace_section(args.doc, SECTION, as_markdown(rows))
    print(json.dumps({"rows": rows}))


def presets_of(name: str) -> list[str]:
    """List the presets in which a stage, or one that its command runs first, differs."""
    stages = with_required([name])
    return [p for p in PRESETS if p == "standard" or any(p in stage.presets for stage in stages)]


def sweep_one(base: Dataset, truth: Truth, stage: str, preset: str, out: Path) -> dict:
    """Run one stage with one preset beside the base dataset; gives seconds per item and error."""
    dataset = Dataset(out / f"{stage}-{preset}")
    dataset.root.mkdir(parents=True, exist_ok=True)
    number = [one.name for one in STAGES].index(stage)
    before = [one.name for one in STAGES[:number]]
    # What its own command runs first is run with its preset.
    for name in ("captures.json", *(n for n in before if n not in STAGES[number].runs_first)):
        link = dataset.root / name
        if not link.exists():
            link.symlink_to((base.root / name).resolve())
    command = [sys.executable, "-m", "express50", stage, str(dataset.root), "--preset", preset]
    began = core_seconds()
    done = subprocess.run(
        [*command, "--workers", "0", "--json"], stdout=subprocess.PIPE, check=False
    )
    seconds = core_seconds() - began
    if done.returncode == 2:
        sys.exit(f"tradeoff: {stage} {preset} did not start; see the line above")
    measure, key = MEASURES[stage]
    figures = measure(dataset, truth)
    items = len(list(dataset.stage_dir(stage).rglob("metrics.json")))
    return {
        "stage": stage,
        "preset": preset,
        "seconds_per_item": round(seconds / max(1, items), 3),
        "measure": key,
        "error": round(float(figures[key]), 4),
        "items": items,
    }


def rows_of_others(doc: Path, stages: list[str]) -> list[dict]:
    """Read the document's rows of stages that are not swept this time."""
    text = doc.read_text(encoding="utf-8") if doc.is_file() else ""
    section = text.partition(f"## {SECTION}\n")[2].partition("\n## ")[0]
    rows = []
    for line in section.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 6 and cells[0] in MEASURES and cells[0] not in stages:
            row: dict = {"stage": cells[0], "preset": cells[1], "measure": MEASURES[cells[0]][1]}
            rows.append(row | {"seconds_per_item": float(cells[2]), "error": float(cells[3])})
    return rows


def pareto(rows: list[dict]) -> set[tuple[str, str]]:
    """Find (stage, preset) that no other preset of the stage beats in seconds and error."""
    return {
        (a["stage"], a["preset"])
        for a in rows
        if not any(
            b["stage"] == a["stage"]
            and b is not a
            and b["seconds_per_item"] <= a["seconds_per_item"]
            and b["error"] <= a["error"]
            and (b["seconds_per_item"], b["error"]) != (a["seconds_per_item"], a["error"])
            for b in rows
        )
    }


def write_csv(rows: list[dict], path: Path) -> None:
    """Write the rows as CSV."""
    with path.open("w", newline="") as file:
        fields = list(dict.fromkeys(key for row in rows for key in row))
        writer = csv.DictWriter(file, fields, restval="")
        writer.writeheader()
        writer.writerows(rows)


def plot(rows: list[dict], path: Path) -> None:
    """Plot error against seconds, one panel per stage."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    stages = list(dict.fromkeys(r["stage"] for r in rows))
    figure, panels = pyplot.subplots(
        1, len(stages), figsize=(3.2 * len(stages), 2.8), squeeze=False
    )
    for axes, stage in zip(panels[0], stages, strict=True):
        own = [r for r in rows if r["stage"] == stage]
        axes.plot(
            [r["seconds_per_item"] for r in own], [r["error"] for r in own], "o-", color="#2457a6"
        )
        # Each label is one line above the one before, as presets of equal cost share a place.
        for line, r in enumerate(own):
            axes.annotate(
                r["preset"], (r["seconds_per_item"], r["error"]), (4, 4 + 9 * line),
                textcoords="offset points", fontsize=8,
            )  # fmt: skip
        axes.set_xlim(0, 1.4 * max(r["seconds_per_item"] for r in own))
        axes.set_ylim(0, 1.3 * max(r["error"] for r in own))
        axes.set_title(f"{stage}: {WORDS[own[0]['measure']]}", fontsize=8)
        axes.set_xlabel("seconds per item", fontsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def as_markdown(rows: list[dict]) -> list[str]:
    """Format the section of the document."""
    front = pareto(rows)
    lines = [
        "Made by `make tradeoff` on the demo's synthetic captures (4 subjects, 8 cameras, 320 px),"
        " one process, against ground truth. Seconds are processor seconds, including the start of"
        " the command; an item of `matte` is one peak frame with all its cameras. A star marks a"
        " preset that no other preset of its stage beats in both time and error. At this size,"
        " `reference` gives what `standard` gives: it is for larger pictures. `express50 tune`"
        " measures the whole chain on your own footage, without ground truth.",
        "",
    ]
    lines += markdown_table(
        ["stage", "preset", "seconds per item", "error", "measure", ""],
        [
            [
                r["stage"], r["preset"], f"{r['seconds_per_item']:.3g}", f"{r['error']:.3g}",
                WORDS[r["measure"]], "*" if (r["stage"], r["preset"]) in front else "",
            ]
            for r in rows
        ],
    )  # fmt: skip
    return [*lines, "", "![error against seconds](tradeoffs.png)"]


if __name__ == "__main__":
    main()
