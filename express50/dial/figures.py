"""Hold the size of footage and what a pilot measured on it, as in ``dial/measured.json``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from express50.capture.index import UNKNOWN_HASH, read_index
from express50.contract.layout import Dataset
from express50.contract.stage import Growth, stages
from express50.errors import FormatError, StageError, advised
from express50.files.text import read_json_table, read_toml

SHORT_SIDE = 0.75  # of a picture over its long side if its shape is not known


@dataclass(frozen=True, kw_only=True)
class Footage:
    """The size of a campaign; means over subjects where it was measured."""

    subjects: float
    expressions: float
    views: float
    pixels: float
    frames: float
    side: float = 0.0  # pixels, to which the longer side of peak frames is reduced; 0: not
    shape: float = SHORT_SIDE  # their shorter side over the longer one
    every: float = 1.0  # ingest decodes one of so many frames

    @property
    def decoded(self) -> float:
        """Return the number of a camera's frames that ingest decodes: at least the first."""
        return max(1.0, self.frames / self.every)

    @property
    def picture(self) -> float:
        """Return the pixels of a peak frame."""
        return self._at_most(self.side)

    @property
    def converted(self) -> float:
        """Return the mean of the pixels that are decoded and written where pictures are reduced."""
        return (self.pixels + self.picture) / 2

    def _at_most(self, side: float) -> float:
        """Return the pixels of an image whose longer side is reduced to `side`, unless it is 0."""
        return min(self.pixels, self.shape * side**2) if side else self.pixels

    def work(self, factors: Sequence[str]) -> float:
        """Return the product of the named sizes."""
        return math.prod(getattr(self, name) for name in factors)

    def time(self, growth: Growth) -> float:
        """Return the size that the seconds of a stage's item are proportional to."""
        return replace(self, pixels=self._at_most(growth.side)).work(growth.time)

    def after(self, growth: Growth, config: Any) -> Footage:
        """Return this footage after a stage, whose settings may reduce its pictures."""
        key = growth.reduces
        return replace(self, side=float(getattr(config, key))) if key else self

    def items(self, growth: Growth) -> float:
        """Return the number of items of a stage."""
        return self.work(growth.items) + (self.work(growth.more) if growth.more else 0.0)


def footage_of(dataset: Dataset) -> Footage:
    """Average the size of a dataset's footage; StageError if nothing is ingested."""
    indices = [read_index(dataset, subject) for subject in dataset.subjects()]
    if not indices:
        ingest = advised("express50 ingest", dataset.root, "CAPTURE")
        raise StageError(
            f"{dataset.root}: nothing is ingested, so nothing was measured; run {ingest}"
        )
    cameras = [camera for index in indices for camera in index.cameras.values()]
    sizes = [(camera.width, camera.height) for camera in cameras]
    frames = sum(camera.frames for camera in cameras)
    decoded = sum(camera.frames - camera.dhash.count(UNKNOWN_HASH) for camera in cameras)
    return Footage(
        subjects=len(indices),
        expressions=sum(len(index.cues) for index in indices) / len(indices),
        views=len(cameras) / len(indices),
        pixels=sum(width * height for width, height in sizes) / len(sizes),
        frames=frames / len(cameras),
        side=_last_setting(dataset, "reduces", 0.0),
        shape=sum(min(size) / max(size) for size in sizes) / len(sizes),
        # Fewer are decoded in videos with few key frames, and a larger share of short ones.
        every=max(frames / max(decoded, 1), _last_setting(dataset, "skips", 1.0)),
    )


def _last_setting(dataset: Dataset, kind: str, default: float) -> float:
    """Return the last run's value of the setting that stages name as ``kind`` in their `Growth`."""
    value = default
    for name, stage in stages().items():
        path, key = dataset.config_file(name), getattr(stage.growth, kind)
        if key and path.is_file():
            value = float(read_toml(path, FormatError).get(name, {}).get(key, default))
    return value


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What an item of a stage costs: typical seconds, and bytes; the most memory."""

    seconds: float
    core_seconds: float
    bytes: float
    memory: float
    items: int
    extra: float = 0.0  # seconds of the clock that the stage took beside its items


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
    """What was measured of a dataset."""

    key: str  # digest of stages, settings and machine; figures of another key say nothing
    trials: list[Trial]  # first at the cheapest settings, then of one peak, then one step each
    # difference from the most expensive setting tried, by stage, setting and result
    losses: dict[str, dict[str, dict[str, float]]]
    untried: dict[str, list[str]] = field(default_factory=dict)  # by stage, for lack of time


def dial_dir(dataset: Dataset) -> Path:
    """Return the folder of what was measured and chosen."""
    return dataset.root / "dial"


def read_measured(path: Path, key: str | None = None) -> PilotFigures | None:
    """Read what was measured; None if nothing was, or with another key."""
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
