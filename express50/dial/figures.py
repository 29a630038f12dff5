"""Hold the size of footage, what a pilot measured on it, and how seconds grow with that size.

What was measured is in ``dial/measured.json``. The seconds of a stage's item are a constant
(libraries, the head model) plus a part proportional to the sizes that the stage names in its
`Growth`. Two sizes determine both; one leaves only the proportional part.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from express50.capture.index import read_index
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, stages
from express50.errors import FormatError, StageError
from express50.files.text import read_json_table, read_toml

SHORT_SIDE = 0.75  # of a picture over its long side if its shape is not known
DRAWS = 400
LEAST_SPREAD = 0.05  # of a mean: machines vary as much from day to day
ASSUMED_SPREAD = 0.15  # of an item's seconds, as a share, if no size has two items


@dataclass(frozen=True, kw_only=True)
class Footage:
    """Holds the size of a campaign; means over subjects where it was measured.

    ``side`` is the length, pixels, to which the longer side of peak frames is reduced; 0: not.
    ``shape`` is their shorter side over the longer one.
    """

    subjects: float
    expressions: float
    views: float
    pixels: float
    frames: float
    side: float = 0.0
    shape: float = SHORT_SIDE

    @property
    def picture(self) -> float:
        """Return the pixels of a peak frame."""
        return min(self.pixels, self.shape * self.side**2) if self.side else self.pixels

    def work(self, factors: Sequence[str]) -> float:
        """Return the product of the named sizes."""
        return math.prod(getattr(self, name) for name in factors)

    def time(self, growth: Growth) -> float:
        """Return the size that the seconds of a stage's item are proportional to."""
        sides = [side for side in (self.side * ("picture" in growth.time), growth.side) if side]
        seen = replace(self, side=float(min(sides, default=0)))
        return replace(seen, pixels=seen.picture).work(growth.time)

    def items(self, growth: Growth) -> float:
        """Return the number of items of a stage."""
        return self.work(growth.items) + (self.work(growth.more) if growth.more else 0.0)


def footage_of(dataset: Dataset) -> Footage:
    """Average the size of a dataset's footage; StageError if nothing is ingested."""
    indices = [read_index(dataset, subject) for subject in dataset.subjects()]
    if not indices:
        raise StageError(f"{dataset.root}: nothing is ingested, so nothing was measured")
    cameras = [camera for index in indices for camera in index.cameras.values()]
    sizes = [(camera.width, camera.height) for camera in cameras]
    side = 0.0  # to which the settings of the last run reduced pictures
    for name, stage in stages().items():
        path = dataset.config_file(name)
        if stage.growth.reduces and path.is_file():
            table = read_toml(path, FormatError).get(name, {})
            side = float(table.get(stage.growth.reduces, 0))
    return Footage(
        subjects=len(indices),
        expressions=sum(len(index.cues) for index in indices) / len(indices),
        views=len(cameras) / len(indices),
        pixels=sum(width * height for width, height in sizes) / len(sizes),
        frames=sum(camera.frames for camera in cameras) / len(cameras),
        side=side,
        shape=sum(min(size) / max(size) for size in sizes) / len(sizes),
    )


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What an item of a stage costs: typical seconds, and bytes; the most memory.

    ``extra`` are seconds of the clock that the stage took beside its items.
    """

    seconds: float
    core_seconds: float
    bytes: float
    memory: float
    items: int
    extra: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One run of the chain on a few items."""

    settings: dict[str, str]  # name of the setting of each stage
    footage: Footage  # size of the footage that it ran on
    scripted: float  # number of expressions of the whole capture
    costs: dict[str, Cost]  # cost of each stage
    errors: dict[str, list[float]]  # ``[value, low, high]`` that stages state for each result
    failed: dict[str, str]  # per stage that made nothing, the reason
    folder: str  # folder of its outputs, below the pilot's


@dataclass(frozen=True, kw_only=True)
class PilotFigures:
    """What was measured of a dataset.

    Attributes:
        key: digest of stages, settings and machine; figures of another key say nothing.
        trials: the first at the cheapest settings, the second of one peak, then one step each.
        losses: difference from the most expensive setting tried, by stage, setting and result.
        untried: settings that there was no time to try, by stage.
    """

    key: str
    trials: list[Trial]
    losses: dict[str, dict[str, dict[str, float]]]
    untried: dict[str, list[str]] = field(default_factory=dict)


def dial_dir(dataset: Dataset) -> Path:
    """Return the folder of what was measured and chosen."""
    return dataset.root / "dial"


def read_measured(path: Path, key: str | None = None) -> PilotFigures | None:
    """Read what was measured; None where nothing was, or with another key."""
    if not path.is_file():
        return None
    table = read_json_table(path, FormatError, "delete it, and it is measured again")
    try:
        if key is not None and table["key"] != key:
            return None
        trials = [trial_of(row) for row in table["trials"]]
        return PilotFigures(
            key=table["key"], trials=trials, losses=table["losses"], untried=table["untried"]
        )
    except (KeyError, TypeError) as error:
        raise FormatError(f"{path}: not the figures of a pilot ({error}); delete it") from error


def trial_of(row: Mapping[str, Any]) -> Trial:
    """Read a trial from its JSON form."""
    costs = {name: Cost(**cost) for name, cost in row["costs"].items()}
    return Trial(**{**row, "costs": costs, "footage": Footage(**row["footage"])})


@dataclass(frozen=True)
class MeasuredSize:
    """Seconds of each item at one size of footage."""

    work: float
    seconds: Sequence[float]


@dataclass(frozen=True)
class Forecast:
    """Seconds of an item at another size; the interval holds them nine times in ten.

    With ``sizes`` below 2 the constant part is not known: the value is proportional, and the
    interval reaches to what it would be if nothing grew.
    """

    value: float
    low: float
    high: float
    sizes: int


def forecast(samples: Sequence[MeasuredSize], work: float) -> Forecast:
    """Predict the seconds of an item from samples of some sizes, by a parametric bootstrap."""
    if not any(map(any, (sample.seconds for sample in samples))):
        return Forecast(0.0, 0.0, 0.0, len({sample.work for sample in samples}))
    works, means, errors = _weighed(samples)
    draws = np.random.default_rng(0).normal(means, errors, (DRAWS, len(means)))
    value = _law(works, means, errors, work)
    # Constants below 0 are let through here: stopped at 0, draws would spread too little.
    low, high = np.percentile([_law(works, one, errors, work, False) for one in draws], (5, 95))
    sizes = len({*works.tolist()})
    if sizes < 2:
        low, high = min(low, *means), max(high, *means)
    return Forecast(value, max(0.0, min(float(low), value)), max(float(high), value), sizes)


def typical_seconds(samples: Sequence[MeasuredSize], work: float) -> float:
    """Predict as `forecast` does, without an interval and as quickly as it can be done."""
    return _law(*_weighed(samples), work)


def _weighed(samples: Sequence[MeasuredSize]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return work (S,), mean seconds (S,) above 0, and the errors (S,) of these."""
    works = np.array([sample.work for sample in samples])
    means = np.maximum([np.mean(sample.seconds) for sample in samples], 1e-9)
    counts = np.array([len(sample.seconds) for sample in samples])
    free, spread = int((counts - 1).sum()), ASSUMED_SPREAD  # the same share at all sizes
    if free > 2:
        squares = [float(np.var(s.seconds)) * len(s.seconds) for s in samples]
        # Student's variance instead of the normal one: the spread is measured on a few items.
        spread = float(np.sqrt((np.array(squares) / means**2).sum() / (free - 2)))
    errors = np.maximum(spread / np.sqrt(counts), LEAST_SPREAD) * means
    # A mean that came out low must not weigh more for it: errors are relative to the fitted law.
    errors *= np.array([_law(works, means, errors, one) for one in works]) / means
    return works, means, errors


def _law(
    works: np.ndarray, seconds: np.ndarray, errors: np.ndarray, at: float, bounded: bool = True
) -> float:
    """Fit constant and slope, neither below 0 if bounded, by weighted least squares."""
    weights = 1 / errors
    rows = np.stack([np.ones_like(works), works / works.max()], 1)
    constant, slope = 0.0, float((weights**2 * rows[:, 1] * seconds).sum())
    slope /= float((weights**2 * rows[:, 1] ** 2).sum())
    if len({*works.tolist()}) > 1:
        found = np.linalg.lstsq(rows * weights[:, None], seconds * weights, rcond=None)[0]
        if found.min() >= 0 or not bounded:
            constant, slope = found
        elif found[1] < 0:  # more work took no longer
            constant, slope = float(np.average(seconds, weights=weights**2)), 0.0
    return float(constant + slope * at / works.max())
