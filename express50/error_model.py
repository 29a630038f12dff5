"""State how wrong results probably are, from what stages see of themselves.

A stage describes each element of a result (a pixel, a vertex, a camera, a peak) by a few positive
figures: residuals, standard deviations, sizes. Their logarithms, weighed and summed, are a score; a
rising table turns the score into the typical error and into the bound that holds nine errors in
ten. Weights and tables were fitted on synthetic people whose truth is known, by ``python -m
benchmarks.intervals --fit``, and lie in ``error_models.json`` with what they were fitted on. Where
figures lie beyond those met there, they count as the nearest met; a figure that is not finite
counts as the worst met.
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
NOMINAL = 0.9  # share of the true errors that bounds and intervals are meant to hold
TINY = 1e-6
PEOPLE_DIFFER = 0.04  # standard deviation of heads' size, as a share
# Of a normal error's size: median, 90th percentile; 5th, 50th and 95th percentile.
HALF, NINE_IN_TEN = 0.674, 1.645
SHARED = 0.063, HALF, 1.96


@dataclass(frozen=True)
class ErrorModel:
    """The fitted constants of one stage.

    Attributes:
        unit: of errors.
        features: names of F figures.
        weights: (F,) of their logarithms; positive where more is worse.
        limits: (F, 2) least and greatest logarithms met.
        scores: (K,) rising knots of the table.
        typical, bound: (K,) logarithms of the median error and of the bound, not falling.
        item: an item's error over the median of its elements' typical errors: the 5th, 50th and
            95th percentile.
    """

    unit: Unit
    features: tuple[str, ...]
    weights: np.ndarray
    limits: np.ndarray
    scores: np.ndarray
    typical: np.ndarray
    bound: np.ndarray
    item: tuple[float, float, float]


@dataclass(frozen=True)
class Bounds:
    """The typical error and the bound (N,) of N elements, and what to expect of them together."""

    typical: np.ndarray
    bound: np.ndarray
    expected: ExpectedError | None


@functools.cache
def error_models() -> dict[str, ErrorModel]:
    """Read the shipped constants, by stage."""
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

    `shared` are standard deviations of a further error that all elements have in common, such as
    that of a lone camera's distance. `expected` is None if N is 0.
    """
    model = model or error_models()[stage]
    score = scores_of(model, figures)
    # Outside the table errors follow their scores, which are logarithms of errors.
    beyond = score - np.clip(score, model.scores[0], model.scores[-1])
    typical, bound = (
        np.exp(np.interp(score, model.scores, table) + beyond)
        for table in (model.typical, model.bound)
    )
    typical, bound = np.hypot(typical, HALF * shared), np.hypot(bound, NINE_IN_TEN * shared)
    return Bounds(typical, bound, expect(model, typical, shared))


def size_sigma(cameras: Sequence[Camera], places: np.ndarray) -> np.ndarray:
    """Return deviations (N,), millimetres, of places (N, 3), metres, along a lone camera's rays.

    One camera cannot distinguish a large head from a near one. With several cameras they are 0.
    """
    if len(cameras) != 1:
        return np.zeros(len(places))
    return 1e3 * PEOPLE_DIFFER * np.linalg.norm(places - cameras[0].center, axis=1)


def scores_of(model: ErrorModel, figures: Mapping[str, np.ndarray | float]) -> np.ndarray:
    """Return the scores (N,) of N elements."""
    rows = np.broadcast_arrays(*(np.atleast_1d(figures[name]) for name in model.features))
    total = np.zeros(rows[0].shape)
    for values, weight, (low, high) in zip(rows, model.weights, model.limits, strict=True):
        worst = high if weight > 0 else low
        known = np.isfinite(values)
        logs = np.log(np.maximum(np.where(known, values, 1.0), TINY))
        total += weight * np.where(known, np.clip(logs, low, high), worst)
    return total


def expect(
    model: ErrorModel, typical: np.ndarray, shared: np.ndarray | float = 0.0
) -> ExpectedError | None:
    """Return what an item of elements with these typical errors (N,) is expected to err.

    `shared` are deviations that are part of them, as in `error_bounds`.
    """
    if not typical.size:
        return None
    common = float(np.median(shared))
    own = np.sqrt(np.maximum(typical**2 - np.square(HALF * shared), 0))
    low, value, high = (
        float(np.hypot(item_error(own, model.unit) * ratio, share * common))
        for ratio, share in zip(model.item, SHARED, strict=True)
    )
    return ExpectedError(value, low, high, model.unit)


def item_error(errors: np.ndarray, unit: Unit) -> float:
    """Return the error of an item from its elements' (N,): the median, or of opacity the mean.

    Most of a matte's rim is right to the last bit, so that the median would say nothing.
    """
    return float(np.mean(errors) if unit == "alpha" else np.median(errors))
