"""Estimate the cost of a capture campaign from the receipts of a measured dataset.

Seconds and bytes per item grow with the footage as each stage declares in its `Growth`: linearly
in the product of the sizes named there, or with the exponent that two datasets of different size
show. Memory has a part that does not grow (libraries, the head model); one dataset cannot separate
it, so memory is then given as measured, a lower bound, and from two datasets by the line through
both.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from express50.capture.index import read_index
from express50.contract.config import config_toml, resolve_config
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, Stage
from express50.errors import ConfigError, StageError
from express50.files.digests import files_of, text_digest
from express50.runner.ledger import Ledger


@dataclass(frozen=True, kw_only=True)
class Footage:
    """Holds the size of a campaign; means over subjects where it was measured."""

    subjects: float
    expressions: float
    views: float
    pixels: float
    frames: float

    def work(self, factors: Sequence[str]) -> float:
        """Multiply some of its sizes."""
        return math.prod(getattr(self, name) for name in factors)


# Campaigns of the papers: EXPRESS-50, and RenderMe-360 as it was used beside it (280 of its people,
# 12 expressions, 60 cameras). Clips are as long as the measured dataset's.
TARGETS: dict[str, dict[str, float]] = {
    "express-50": {"subjects": 50, "expressions": 60, "views": 24, "pixels": 3840 * 2160},
    "renderme-360": {"subjects": 280, "expressions": 12, "views": 60, "pixels": 2448 * 2048},
}


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Holds what one stage cost in one dataset: means per item, peak over items, and the preset."""

    footage: Footage
    items: int
    seconds: float
    bytes: float
    memory: float
    preset: str


@dataclass(frozen=True, kw_only=True)
class Row:
    """Holds the estimate of one stage; ``why`` instead of figures where there are none.

    ``memory_grows`` says that peak memory was scaled; else it is as measured, a lower bound.
    """

    stage: str
    items: int
    seconds: float | None = None
    core_hours: float | None = None
    days: float | None = None
    disk: float | None = None
    memory: float | None = None
    memory_grows: bool = False
    preset: str = ""
    how: str = ""
    why: str = ""


def footage_of(dataset: Dataset) -> Footage:
    """Average the size of a dataset's footage.

    Raises:
        StageError: nothing is ingested.
    """
    indices = [read_index(dataset, subject) for subject in dataset.subjects()]
    if not indices:
        raise StageError(f"{dataset.root}: nothing is ingested, so nothing was measured")
    cameras = [camera for index in indices for camera in index.cameras.values()]
    return Footage(
        subjects=len(indices),
        expressions=sum(len(index.cues) for index in indices) / len(indices),
        views=len(cameras) / len(indices),
        pixels=sum(camera.width * camera.height for camera in cameras) / len(cameras),
        frames=sum(camera.frames for camera in cameras) / len(cameras),
    )


def measure(dataset: Dataset, stages: Sequence[Stage]) -> dict[str, Measured]:
    """Measure what every stage cost that was run, from its receipts and files.

    Raises:
        StageError: the ledger is missing, or nothing is ingested.
    """
    if not dataset.ledger.is_file():
        raise StageError(f"{dataset.root}: no ledger.sqlite; expected a dataset that was made")
    footage, found = footage_of(dataset), {}
    with Ledger(dataset.ledger, read_only=True) as ledger:
        for stage in stages:
            done = [r for r in ledger.read(stage.name).values() if r.status == "done"]
            if not done:
                continue
            sizes = [
                sum(path.stat().st_size for path in files_of(dataset.item_dir(stage.name, r.item)))
                for r in done
            ]
            found[stage.name] = Measured(
                footage=footage,
                items=len(done),
                seconds=sum(r.seconds for r in done) / len(done),
                bytes=sum(sizes) / len(done),
                memory=max(r.peak_memory for r in done),
                preset=preset_of(dataset, stage),
            )
    return found


def preset_of(dataset: Dataset, stage: Stage) -> str:
    """Return the preset whose values a stage last ran with, or ``own`` and a digest of these."""
    path = dataset.config_file(stage.name)
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    for preset in stage.presets:
        if config_toml(stage.name, resolve_config(stage, preset)) == text:
            return preset
    return f"own {text_digest(text)[:6]}"


def target_of(name: str | None, sizes: Mapping[str, float], measured: Footage) -> Footage:
    """Choose the campaign to estimate: a named one, single sizes over it, the rest as measured.

    Args:
        name: of `TARGETS`, or None.
        sizes: given sizes by their names in `Footage`, and ``frames_per_expression``.
        measured: footage of the measured dataset.

    Raises:
        ConfigError: a size is not above 0.
    """
    if bad := {key: value for key, value in sizes.items() if not value > 0}:
        told = ", ".join(f"{key} is {value}" for key, value in bad.items())
        raise ConfigError(f"target: {told}; expected more than 0")
    values = {key: getattr(measured, key) for key in ("subjects", "expressions", "views", "pixels")}
    values |= TARGETS.get(name or "", {}) | dict(sizes)
    each = measured.frames / max(measured.expressions, 1)
    each = values.pop("frames_per_expression", each)
    return Footage(**values, frames=each * values["expressions"])


def estimate(
    stages: Sequence[Stage],
    target: Footage,
    measured: Sequence[Mapping[str, Measured]],
    workers: int,
    preset: str | None = None,
) -> list[Row]:
    """Estimate one row per stage.

    Args:
        stages: in order.
        target: the campaign.
        measured: one or two datasets' measurements.
        workers: processes of one core each.
        preset: only figures measured with it count; None takes the first dataset's.
    """
    rows = []
    for stage in stages:
        items = round(target.work(stage.growth.items))
        tables = [table[stage.name] for table in measured if stage.name in table]
        # Two presets' figures on one curve would be a fit of nothing.
        wanted = preset or (tables[0].preset if tables else "")
        usable = [m for m in tables if m.preset == wanted]
        if not usable:
            with_others = ", ".join(sorted({m.preset for m in tables}))
            why = f"measured with {with_others}, not {preset}" if tables else "was not run"
            rows.append(Row(stage=stage.name, items=items, why=why))
        else:
            rows.append(_row(stage.name, stage.growth, items, target, usable, workers))
    return rows


def _row(
    stage: str,
    growth: Growth,
    items: int,
    target: Footage,
    measured: Sequence[Measured],
    workers: int,
) -> Row:
    ordered = sorted(measured, key=lambda m: m.footage.work(growth.time))
    seconds, how = _scaled([m.seconds for m in ordered], ordered, growth.time, target)
    disk, _ = _scaled([m.bytes for m in ordered], ordered, growth.disk, target)
    memory, grows = _memory(ordered, growth.time, target)
    hours = items * seconds / 3600
    return Row(
        stage=stage,
        items=items,
        seconds=seconds,
        core_hours=hours,
        days=hours / 24 / min(workers, items),
        disk=items * disk,
        memory=memory,
        memory_grows=grows,
        preset=measured[0].preset,
        how=how,
    )


def _scaled(
    values: Sequence[float], measured: Sequence[Measured], factors: tuple[str, ...], target: Footage
) -> tuple[float, str]:
    """Scale a figure per item to the target's size; return it and how it was found."""
    works = [m.footage.work(factors) for m in measured]
    goal = target.work(factors)
    words = " x ".join(factors)
    if len(works) > 1 and works[-1] > 1.2 * works[0] and values[0] > 0:
        power = math.log(values[-1] / values[0]) / math.log(works[-1] / works[0])
        if power > 0:
            ratio = goal / works[-1]
            return values[-1] * ratio**power, f"({words} = {ratio:.4g})^{power:.2f}, fitted"
    ratio = goal / works[-1]
    return values[-1] * ratio, f"{words} = {ratio:.4g}"


def _memory(
    measured: Sequence[Measured], factors: tuple[str, ...], target: Footage
) -> tuple[float, bool]:
    """Return peak bytes on the line through two measurements, else the largest, and which."""
    works = [m.footage.work(factors) for m in measured]
    largest = max(m.memory for m in measured)
    if len(works) < 2 or works[-1] <= 1.2 * works[0]:
        return largest, False
    slope = (measured[-1].memory - measured[0].memory) / (works[-1] - works[0])
    return max(largest, measured[-1].memory + slope * (target.work(factors) - works[-1])), True


def totals(rows: Sequence[Row]) -> dict[str, Any]:
    """Add up the stages that were measured, and list those that were not."""
    known = [row for row in rows if not row.why]
    return {
        "core_hours": sum(row.core_hours or 0.0 for row in known),
        "days": sum(row.days or 0.0 for row in known),
        "disk": sum(row.disk or 0.0 for row in known),
        "presets": dict(Counter(row.preset for row in known)),
        "not_measured": [row.stage for row in rows if row.why],
    }
