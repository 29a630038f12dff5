"""Estimate how wrong results probably are, from figures that stages measure without ground truth.

A stage describes each element of a result (a pixel, a vertex, a camera, a peak) by a few positive
figures: residuals, standard deviations, sizes. The weighted sum of their logarithms is a score. A
monotonic table maps it to the typical error, and to a bound that nine errors in ten stay under.
Weights and tables were fitted on synthetic people by ``python -m benchmarks.intervals --fit`` and
are in ``error_models.json``, with a description of the data. Figures are clipped to the range of
that data; a figure that is not finite counts as the worst in it.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from express50.contract.stage import ExpectedError, Unit
from express50.geometry.cameras import Camera

FILE = Path(__file__).with_name("error_models.json")
HEAD_SIZE_SPREAD = 0.04  # standard deviation of heads' size, as a share
# Percentiles of |x| for a standard normal x: 50th and 90th; 5th, 50th and 95th.
HALF, NINE_IN_TEN = 0.674, 1.645
SHARED = 0.063, HALF, 1.96


@dataclass(frozen=True)
class ErrorModel:
    """The fitted constants of one stage."""

    unit: Unit  # unit of errors
    features: tuple[str, ...]  # names of the F figures
    weights: np.ndarray  # (F,) weights of their logarithms; positive if a larger figure is worse
    limits: np.ndarray  # (F, 2) smallest and largest logarithm in the data
    scores: np.ndarray  # (K,) ascending knots of the table
    typical: np.ndarray  # (K,) logarithms of the median error, non-decreasing
    bound: np.ndarray  # (K,) logarithms of the bound, non-decreasing
    # 5th, 50th and 95th percentile of an item's error divided by the median of its elements'
    # typical errors
    item: tuple[float, float, float]


@dataclass(frozen=True)
class Bounds:
    """The typical error and the bound (N,) of N elements, and the expected error of their item."""

    typical: np.ndarray
    bound: np.ndarray
    expected: ExpectedError | None


@functools.cache
def error_models() -> dict[str, ErrorModel]:
    """Return the shipped constants, by stage."""
    found = {}
    for stage, row in json.loads(FILE.read_text())["stages"].items():
        arrays = {k: np.array(row[k]) for k in ("weights", "limits", "scores", "typical", "bound")}
        found[stage] = ErrorModel(
            unit=row["unit"], features=tuple(row["features"]), item=tuple(row["item"]), **arrays
        )
    return found


def error_bounds(
    stage: str,
    figures: Mapping[str, np.ndarray | float],
    shared: np.ndarray | float = 0.0,
    model: ErrorModel | None = None,
) -> Bounds:
    """Return the bounds of N elements from their figures, each (N,) or one for all.

    `shared` is the standard deviation of an additional error that all elements have in common, such
    as that of the distance from a single camera. `expected` is None if N is 0.
    """
    model = model or error_models()[stage]
    score = scores_of(model, figures)
    # Extrapolate with slope 1 beyond the table: scores are logarithms of errors.
    beyond = score - np.clip(score, model.scores[0], model.scores[-1])
    typical, bound = (
        np.exp(np.interp(score, model.scores, table) + beyond)
        for table in (model.typical, model.bound)
    )
    if np.any(shared):
        typical, bound = np.hypot(typical, HALF * shared), np.hypot(bound, NINE_IN_TEN * shared)
    return Bounds(typical, bound, expect(model, typical, shared))


def single_camera_sigma(cameras: Sequence[Camera], places: np.ndarray) -> np.ndarray:
    """Return the depth uncertainty (N,) in millimetres of points (N, 3) in metres.

    A single camera cannot distinguish a large head from a near one. With several cameras it is 0.
    """
    if len(cameras) != 1:
        return np.zeros(len(places))
    return 1e3 * HEAD_SIZE_SPREAD * np.linalg.norm(places - cameras[0].center, axis=1)


def scores_of(model: ErrorModel, figures: Mapping[str, np.ndarray | float]) -> np.ndarray:
    """Return the scores (N,) of N elements."""
    total = np.zeros(1, np.float32)  # exact enough, in a third of the time
    rows = zip(model.features, model.weights.tolist(), np.exp(model.limits).tolist(), strict=True)
    for name, weight, (low, high) in rows:
        values = np.atleast_1d(figures[name])
        values = np.where(np.isfinite(values), values, high if weight > 0 else low)
        total = total + weight * np.log(np.clip(values, low, high).astype(np.float32, copy=False))
    return total


def expect(
    model: ErrorModel, typical: np.ndarray, shared: np.ndarray | float = 0.0
) -> ExpectedError | None:
    """Return the expected error of an item whose elements have these typical errors (N,).

    `shared` standard deviations are included in them, as in `error_bounds`.
    """
    if not typical.size:
        return None
    common = float(np.median(shared))
    own = np.sqrt(np.maximum(typical**2 - np.square(HALF * shared), 0))
    error = item_error(own, model.unit)
    low, value, high = (
        float(np.hypot(error * ratio, share * common))
        for ratio, share in zip(model.item, SHARED, strict=True)
    )
    return ExpectedError(value, low, high, model.unit)


def item_error(errors: np.ndarray, unit: Unit) -> float:
    """Return the error of an item from its elements' errors (N,): the median, for opacity the mean.

    Most pixels of a matte's rim are exactly right, so their median would be 0.
    """
    return float(np.mean(errors) if unit == "alpha" else np.median(errors))
