"""Measure the size of a dataset's footage, which the cost of stages is proportional to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from express50.capture.index import read_index
from express50.contract.layout import Dataset
from express50.errors import StageError


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
