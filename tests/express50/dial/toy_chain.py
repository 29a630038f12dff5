"""A chain of toys behind the real ingest: errors and times follow from settings exactly.

``align`` takes the first frame of every cue window. ``solve`` (a subject) and ``map`` (a peak)
pause ``steps`` times and leave an error of 2 and 1 mm per step. What fewer steps add is independent
of what the most leave, and so is a rest that no setting removes: squares add up.
"""

from __future__ import annotations

import json
import math
import os
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from express50.capture.index import peak_items, read_index
from express50.contract.config import distinct_settings
from express50.contract.layout import Dataset
from express50.contract.stage import ExpectedError, Growth, Result, Stage
from express50.dial.pilot import Chain
from express50.dial.results import ResultKind
from express50.errors import StageError
from express50.runner.executor import Pool
from pipelines import ingest
from tests.synth import make_capture

PAUSE = "EXPRESS50_TOY_PAUSE"  # seconds of a step
FAILS = "EXPRESS50_TOY_FAILS"  # "stage steps": raises at these steps
STOPS = "EXPRESS50_TOY_STOPS"  # "stage item": is interrupted there, once
REST = 0.5
pause = time.sleep


@dataclass(frozen=True, kw_only=True)
class StepsConfig:
    """How long to work."""

    steps: int = 4
    """Number of pauses."""


@dataclass(frozen=True, kw_only=True)
class NoConfig:
    """Nothing to set."""


def _align(dataset: Dataset, item: str, config: NoConfig, out: Path) -> Result:
    index = read_index(dataset, item)
    rows = {}
    for cue in index.cues:
        footage, frame = index.cameras["cam00"], cue.start_frame
        rows[cue.expression_id] = {
            "frame": frame, "camera": "cam00", "pts": footage.pts[frame],
            "dhash": footage.dhash[frame],
        }  # fmt: skip
    (out / "peaks.json").write_text(json.dumps(rows))
    return Result()


ALIGN = Stage(
    name="align",
    version=1,
    config=NoConfig,
    items=Dataset.subjects,
    inputs=lambda dataset, item, config: {"index": dataset.index_file(item)},
    run=_align,
    growth=Growth(items=("subjects",), time=("frames",)),
)


def _work(stage: str, item: str, steps: int, times: int) -> None:
    if os.environ.get(FAILS) in (stage, f"{stage} {steps}"):
        raise StageError(f"{item}: {steps} steps lead nowhere")
    if os.environ.get(STOPS) == f"{stage} {item}":
        del os.environ[STOPS]
        raise KeyboardInterrupt
    pause(float(os.environ.get(PAUSE, "0.001")) * steps * times)


def count_pauses(monkeypatch: pytest.MonkeyPatch, working: float = 1.0) -> None:
    """Let a step take one second, and nothing else any, without waiting.

    ``working`` is the share of it that is processor time.
    """
    spent = [0.0]

    def pass_by(seconds: float) -> None:
        spent[0] += seconds

    monkeypatch.setenv(PAUSE, "1")
    monkeypatch.setattr("tests.express50.dial.toy_chain.pause", pass_by)
    monkeypatch.setattr("express50.runner.worker.core_seconds", lambda: working * spent[0])
    monkeypatch.setattr("express50.runner.worker.time.perf_counter", lambda: spent[0])


def added(size: float, steps: int) -> float:
    """Return the error that fewer steps add to that of the most, millimetres."""
    return size * math.sqrt(1 / steps**2 - 1 / 16**2)


def _solve(dataset: Dataset, item: str, config: StepsConfig, out: Path) -> Result:
    peaks = json.loads(dataset.peaks_file(item).read_text())
    _work("solve", item, config.steps, len(peaks))
    error = {"error": 2.0 / config.steps, "added": added(2.0, config.steps), "peaks": len(peaks)}
    (out / "error.json").write_text(json.dumps(error))
    return Result({"steps": config.steps})


SOLVE = Stage(
    name="solve",
    version=1,
    config=StepsConfig,
    presets={"draft": {"steps": 1}, "reference": {"steps": 16}},
    items=Dataset.subjects,
    inputs=lambda dataset, item, config: {"peaks": dataset.peaks_file(item)},
    run=_solve,
    growth=Growth(items=("subjects",), time=("expressions",)),
)


def _map(dataset: Dataset, item: str, config: StepsConfig, out: Path) -> Result:
    _work("map", item, config.steps, 2)
    solved = json.loads((dataset.item_dir("solve", item.split("/")[0]) / "error.json").read_text())
    error = math.hypot(1.0 / config.steps, solved["error"], REST)
    parts = {"own": added(1.0, config.steps), "before": solved["added"]}
    (out / "value.json").write_text(json.dumps(parts))
    return Result(expected_error=ExpectedError(error, 0.8 * error, 1.25 * error, "mm"))


MAP = Stage(
    name="map",
    version=1,
    config=StepsConfig,
    presets={"draft": {"steps": 1}, "reference": {"steps": 16}},
    items=peak_items,
    inputs=lambda dataset, item, config: {
        "solve": dataset.item_dir("solve", item.split("/")[0]) / "error.json"
    },
    run=_map,
    growth=Growth(items=("subjects", "expressions")),
)


def _apart(a: Dataset, b: Dataset, subject: str, names: list[str]) -> list[float]:
    found = []
    for name in names:
        files = [d.item_dir("map", f"{subject}/{name}") / "value.json" for d in (a, b)]
        if all(file.is_file() for file in files):
            one, two = (json.loads(file.read_text()) for file in files)
            found.append(math.hypot(*(one[key] - two[key] for key in one)))
    return found


KINDS = (
    ResultKind("value", "mm", (lambda d, s, e, c: d.item_dir("map", f"{s}/{e}") / "v",), _apart),
)
STAGES = (ingest.STAGE, ALIGN, SOLVE, MAP)


def captures_of(
    root: Path, subjects: int = 3, expressions: int = 4, plates: bool = False
) -> list[Path]:
    names = tuple(f"e{number}" for number in range(expressions))
    for number in range(subjects):
        make_capture(
            root / f"S{number}", subject=f"S{number}", cameras=2, frames=4 * expressions, size=48,
            plates=plates, expressions=names,
        )  # fmt: skip
    return [root / f"S{number}" for number in range(subjects)]


def chain_of(root: Path, captures: list[Path], said: list[str] | None = None) -> Chain:
    dataset = Dataset(root.resolve())
    ingest.add_captures(dataset, captures)
    ladders = {stage.name: distinct_settings(stage) for stage in STAGES}
    ladders["ingest"] = {"standard": ladders["ingest"]["standard"]}
    tell = (said if said is not None else []).append
    return Chain(STAGES, dataset, ladders, Pool(0), tell, KINDS)


def error_of(settings: dict[str, str]) -> float:
    """Return the true error of a choice."""
    steps = {"draft": 1, "standard": 4, "reference": 16}
    return math.hypot(2.0 / steps[settings["solve"]], 1.0 / steps[settings["map"]], REST)
