"""Files of cases: made once, deterministic by (seed, head model, number)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from express50.head.model import HeadModel
from pipelines.track.chart.cases import draw_case, draw_person
from pipelines.track.chart.disturb import Case
from pipelines.track.chart.layout import make_chart

FILE_CASES, CASES_A_PERSON = 60, 2


def make_cases(folder: Path, model: HeadModel, number: int, seed: int) -> Path:
    """Draw one file of `FILE_CASES` cases, unless it is there already."""
    path = folder / f"chart-{model.name}-{seed}-{number:03d}.npz"
    if path.exists():
        return path
    rng = np.random.default_rng([seed, number, *model.name.encode()])
    chart, cases = make_chart(model), list[Case]()
    while len(cases) < FILE_CASES:
        person = draw_person(model, chart, rng)
        cases += [draw_case(model, chart, person, rng) for _ in range(CASES_A_PERSON)]
    folder.mkdir(parents=True, exist_ok=True)
    # Two processes that happen to draw the same file write the same bytes.
    part = path.with_suffix(f".{os.getpid()}.part")
    with part.open("wb") as file:
        names = Case.__annotations__
        stacks: dict[str, Any] = {n: np.stack([getattr(case, n) for case in cases]) for n in names}
        np.savez(file, **stacks)
    part.rename(path)
    return path


def read_cases(path: Path) -> list[Case]:
    """Read a file of cases."""
    with np.load(path, allow_pickle=False) as data:
        stacks = {name: data[name] for name in Case.__annotations__}
    return [
        Case(**{name: stack[index] for name, stack in stacks.items()})
        for index in range(len(stacks["valid"]))
    ]
