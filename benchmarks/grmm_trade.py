"""Measure what GRMM's settings cost and gain.

Usage: ``python -m benchmarks.grmm_trade SHARDS [--budgets 60 240]``.

One thing is changed at a time from the demo preset; every setting trains again for each budget of
processor seconds, so that other work on the machine disturbs little, and is judged on one held-out
camera at the shards' own size. Writes the table into docs/TRADEOFFS.md with ``--doc``, and what
``grmm train --budget`` chooses from with ``--choices``. The last line is one JSON object.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from benchmarks.common import make_parser, replace_section
from benchmarks.grmm import held_out
from express50.files.atomic import write_json
from express50.files.text import markdown_table
from express50.geometry.sampling import evenly
from express50.head.load import load_head
from grmm.config import Config, as_tables, from_tables, resolve
from grmm.data import HeadViews, Place, Sample, SampleKey, Source
from grmm.evaluate import evaluate, mean, training_render
from grmm.shard_source import open_shards
from grmm.train import step
from grmm.train_state import finished, prepare, set_rates, with_map_size
from grmm.warm_start import warm_start

Changes = dict[str, dict[str, object]]
SETTINGS: dict[str, tuple[Changes, int]] = {  # name -> changes of tables, pixels divided by
    "demo preset": ({}, 1),
    "n_g 64": ({"model": {"n_g": 64}}, 1),
    "n_g 256": ({"model": {"n_g": 256}}, 1),
    "n_g by pixels": ({"model": {"n_g": 0}}, 1),
    "no refinement": ({"model": {"refine_widths": []}}, 1),
    "n_g 256, no refinement": ({"model": {"n_g": 256, "refine_widths": []}}, 1),
    "refinement at half": ({"model": {"refine_unshuffle": 2}}, 1),
    "half the pixels per side": ({}, 2),
}
HEADING = "Settings of GRMM"
NOISE_DB = 0.1  # of a run's PSNR


class Smaller:
    """A source whose images are reduced; depth is kept where all of a pixel's parts have it."""

    def __init__(self, source: Source, factor: int) -> None:
        """Divide the sides of every image of ``source`` by ``factor``."""
        self.source, self.factor = source, factor
        self.keys: Sequence[SampleKey] = source.keys
        self.head = source.head
        self.digest = f"{source.digest} by {factor}"

    def read(self, index: int) -> Sample:
        """Decode one sample and reduce it."""
        sample, by = self.source.read(index), self.factor
        height, width = (side // by * by for side in sample.alpha.shape)
        size = (width // by, height // by)

        def area(image: np.ndarray) -> np.ndarray:
            return cv2.resize(image[:height, :width], size, interpolation=cv2.INTER_AREA)

        depth = sample.depth
        if depth is not None:
            known = area((depth > 0).astype(np.float32)) > 1 - 1e-4
            depth = np.where(known, area(depth), 0).astype(np.float32)
        return replace(
            sample,
            image=area(sample.image),
            alpha=area(sample.alpha),
            depth=depth,
            parts=None if sample.parts is None else sample.parts[:height:by, :width:by].copy(),
            place=self.place(index),
        )

    def place(self, index: int) -> Place:
        """Return one sample's place in the reduced picture."""
        place, by = self.source.place(index), self.factor
        height, width = (side // by for side in place.size)
        return replace(place, K=np.diag([1 / by, 1 / by, 1.0]) @ place.K, size=(height, width))


def train_for(views: HeadViews, config: Config) -> tuple[torch.nn.Module, int]:
    """Train for ``train.seconds`` of processor time; return the model and its steps."""
    torch.manual_seed(config.train.seed)
    began = time.process_time()
    run = prepare(views, config)
    warm_start(run.model, views, run.training)
    while not finished(run, config):
        set_rates(run, config)
        step(run, run.model, config)
        run.iteration += 1
        run.seconds = time.process_time() - began
    return run.model, run.iteration


def measure(source: Source, base: Config, name: str, budget: float, images: int) -> dict:
    """Measure one setting and budget: held-out PSNR, steps, seconds per picture."""
    changes, factor = SETTINGS[name]
    tables = as_tables(base)
    budgeted = {"seconds": budget, "iterations": 10**6}
    for table in (*changes, "train"):
        tables[table] |= changes.get(table, {}) | (budgeted if table == "train" else {})
    head = load_head(source.head)
    whole = HeadViews(source, head)
    views = whole if factor == 1 else HeadViews(Smaller(source, factor), head)
    config = with_map_size(from_tables(tables), views)
    model, steps = train_for(views, config)
    cameras = config.data.holdout_cameras
    own = [
        i
        for i, key in enumerate(whole.keys)
        if key.camera in cameras and "/".join(key.frame) not in config.data.holdout_expressions
    ]
    began = time.process_time()
    rows = evaluate(whole, evenly(own, images), training_render(model, whole))
    row = {
        "setting": name,
        "budget_s": budget,
        "psnr_db": mean(rows, "psnr_db"),
        "psnr_head_db": mean(rows, "psnr_head_db"),
        "ssim": mean(rows, "ssim"),
        "steps": steps,
        "n_g": config.model.n_g,
        "picture_s": round((time.process_time() - began) / len(rows), 3),
    }
    print(json.dumps(row), file=sys.stderr, flush=True)
    return row


def as_markdown(rows: list[dict], people: int, cameras: int, size: int) -> list[str]:
    """Return the section's lines."""
    text = (
        f"Made by `python -m benchmarks.grmm_trade`: {people} people, {cameras} cameras of {size} "
        "px, two more held out. One setting at a time differs from `--preset demo`. A budget is "
        "processor seconds of one core, counted from the first image read. PSNR is over all pixels "
        "but the torso, and over the head alone. Seconds per picture cover decoding, drawing, "
        "refining and comparing it. Each row is one run; a tenth of a dB is noise."
    )
    head = ["setting", "budget s", "steps", "PSNR dB", "head dB", "SSIM", "seconds per picture"]
    lines = [
        [
            r["setting"], f"{r['budget_s']:.0f}", r["steps"], f"{r['psnr_db']:.2f}",
            f"{r['psnr_head_db']:.2f}", f"{r['ssim']:.3f}", f"{r['picture_s']:.2f}",
        ]
        for r in rows
    ]  # fmt: skip
    return [text, "", *markdown_table(head, lines)]


def choices(rows: list[dict]) -> list[dict]:
    """Find each budget's setting as `grmm.config.choose` reads it: the quickest of the best ones.

    That is, of those whose PSNR is the best within NOISE_DB, the one that draws quickest.
    """
    found = []
    for budget in sorted({row["budget_s"] for row in rows}):
        mine = [row for row in rows if row["budget_s"] == budget]
        enough = max(row["psnr_db"] for row in mine) - NOISE_DB
        best = min((r for r in mine if r["psnr_db"] > enough), key=lambda row: row["picture_s"])
        found.append(
            {"budget_s": budget, "setting": best["setting"], "psnr_db": best["psnr_db"]}
            | {"changes": SETTINGS[best["setting"]][0]}
        )
    return found


def main() -> None:
    """Parse, measure, print."""
    parser = make_parser("grmm_trade", __doc__)
    parser.add_argument("shards", type=Path)
    parser.add_argument("--budgets", type=float, nargs="+", default=[60.0, 240.0])
    parser.add_argument("--settings", nargs="+", default=list(SETTINGS), choices=list(SETTINGS))
    parser.add_argument("--images", type=int, default=18, help="held-out pictures measured")
    parser.add_argument("--doc", type=Path, help="write the table into this file")
    parser.add_argument("--choices", type=Path, help="write the best setting of each budget here")
    args = parser.parse_args()
    torch.set_num_threads(1)
    source = open_shards([args.shards], "train")
    base, _ = held_out(args.shards, resolve("demo"))
    base = replace(base, data=replace(base.data, holdout_expressions=()))
    rows = [
        measure(source, base, name, budget, args.images)
        for budget in args.budgets
        for name in args.settings
    ]
    people = len({key.subject for key in source.keys})
    cameras = len({key.camera for key in source.keys}) - len(base.data.holdout_cameras)
    size = max(source.read(0).alpha.shape)
    if args.doc:
        replace_section(args.doc, HEADING, as_markdown(rows, people, cameras, size))
    if args.choices:
        write_json(args.choices, choices(rows))
    print(json.dumps({"benchmark": "grmm_trade", "rows": rows, "choices": choices(rows)}))


if __name__ == "__main__":
    main()
