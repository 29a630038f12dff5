"""Run stages in the test's own process."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from express50.contract.config import build_config
from express50.contract.layout import Dataset
from express50.contract.stage import Stage
from express50.runner.executor import Pool
from express50.runner.runner import Summary, run_stage
from pipelines import ingest


def run_here(
    stage: Stage,
    dataset: Dataset,
    items: Sequence[str] | None = None,
    preset: str = "standard",
    **settings: object,
) -> Summary:
    """Run a stage with a preset in which some settings are others."""
    config = build_config(stage, {**stage.presets.get(preset, {}), **settings})
    return run_stage(stage, dataset, config, items, pool=Pool(0), progress=False)


def metrics_of(dataset: Dataset, stage: str, item: str) -> dict[str, Any]:
    """Return what a stage said of an item."""
    return json.loads((dataset.item_dir(stage, item) / "metrics.json").read_text())


def notes_of(dataset: Dataset, stage: str, item: str, kind: str = "warnings") -> dict[str, str]:
    """Return the reasons of an item's warnings, or of what was dropped, by what they concern."""
    rows = metrics_of(dataset, stage, item)[kind]
    return {row["what"]: row["why"] for row in rows}


def ingest_captures(root: Path, *captures: Path, preset: str = "draft", every: int = 1) -> Dataset:
    """Make a dataset of raw captures; every frame is decoded unless ``every`` is above 1."""
    dataset = Dataset(root)
    ingest.add_captures(dataset, captures)
    summary = run_here(ingest.STAGE, dataset, preset=preset, every=every)
    assert summary.ok, summary.lines()
    return dataset
