"""Fit how the seconds of a stage's item grow with its footage, and state an interval.

The law is a constant (libraries, the head model) plus a part proportional to the sizes that the
stage names in its `Growth`. Two sizes determine both; one leaves only the proportional part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

DRAWS = 400
LEAST_SPREAD = 0.05  # of a mean: machines vary as much from day to day
ASSUMED_SPREAD = 0.15  # of an item's seconds, as a share, if no size has two items


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
    # Items of all sizes have one relative spread.
    free, spread = int((counts - 1).sum()), ASSUMED_SPREAD
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
