"""Fit the constants of ``express50.error_model`` to samples whose errors are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import isotonic_regression

from benchmarks.intervals_collect import Sample
from express50.contract.stage import Unit
from express50.error_model import ErrorModel, error_bounds, item_error, scores_of

NOMINAL = 0.9  # share of the true errors that bounds and intervals should contain
TINY = 1e-6  # least ratio and figure whose logarithm is taken
KNOTS = 20
LEAST_ELEMENTS = 40  # per knot
FLOORS = {"mm": 0.02, "px": 0.002, "alpha": 0.002, "frames": 0.3, "dB": 0.1}
LEAST = {"mm": 1e-4, "px": 1e-4, "alpha": 1e-4, "frames": 0.5, "dB": 1e-4}
"""Bounds are no less: a peak lies somewhere within its frame."""
ROW_LEVEL = 0.05  # share of a figure's variance within items under which it describes the item
RIDGE = 0.003  # of weights within items: variance of logarithms
# Of weights between items, as a share of each figure's own variance: a voxel's size varies little
# in the data, so one ridge for all figures kept its weight near 0, and finer depth looked worse.
ROW_RIDGE = 0.03
MOST_WIDENED = 3.0  # intervals of items, for differences between people


def fit_model(samples: Sequence[Sample], unit: Unit) -> ErrorModel:
    """Fit weights by least squares of logarithms, then the table; all items have equal weight.

    Figures of elements are fitted within items, and figures of whole items to the differences that
    remain between items: otherwise a few items would decide what a pixel's figure means.
    """
    samples = [s for s in samples if not s.shared.any()]  # that is known, not fitted
    return fit_items(_fit(samples, unit), samples)


def fit_items(model: ErrorModel, samples: Sequence[Sample]) -> ErrorModel:
    """Return a model with intervals that hold for nine in ten items of people not yet seen.

    They hold for nine in ten of these items (conformal prediction, Vovk et al. 2005), and are
    widened until each person's are held as often, on average, by those of the other people.
    """
    if model.unit == "frames":  # whole frames: most are 0
        return replace(model, item=(0.0, 0.0, 1.0))
    ratios: dict[str, list[float]] = {}
    for sample in samples:
        if not sample.shared.any():
            typical = error_bounds("", sample.figures, 0.0, model).typical
            ratio = item_error(sample.errors, model.unit) / item_error(typical, model.unit)
            person = sample.item.split("/")[0]
            ratios.setdefault(person, []).append(float(np.log(max(ratio, TINY))))
    needed, weights = [], []
    for person, own in ratios.items():
        others = [values for other, values in ratios.items() if other != person]
        low, middle, high = _ends(np.concatenate(others or [own]))
        away = np.array(own) - middle
        needed.append(np.abs(away) / np.maximum(np.where(away > 0, high, low), TINY))
        weights.append(np.full(len(own), 1 / len(own)))
    enough = _quantile(np.concatenate(needed), np.concatenate(weights), NOMINAL)
    low, middle, high = _ends(np.concatenate([*ratios.values()]))
    wider = np.clip(enough, 1.0, MOST_WIDENED) * np.array([-low, 0.0, high])
    low, value, high = (float(v) for v in np.exp(middle + wider))
    return replace(model, item=(low, value, high))


def _ends(values: np.ndarray) -> tuple[float, float, float]:
    """Return how far nine in ten values (N,) reach below the middle, the middle, and above it."""
    ordered = np.sort(values)
    cut = max(int((1 - NOMINAL) / 2 * (len(ordered) + 1)) - 1, 0)  # as many left out at either end
    middle = float(np.median(ordered))
    return middle - float(ordered[cut]), middle, float(ordered[-1 - cut]) - middle


def _fit(samples: Sequence[Sample], unit: Unit) -> ErrorModel:
    """Fit all but the items' intervals."""
    names = tuple(samples[0].figures)
    logs = [_logarithms(s, names) for s in samples]
    known = np.concatenate(logs)
    limits = np.stack([np.nanpercentile(known, q, axis=0) for q in (0.5, 99.5)], 1)
    if len(names) == 1:
        return _proportional(names, unit, samples)
    # A figure that is not known counts as the worst met.
    filled = [np.where(np.isfinite(x), np.clip(x, *limits.T), limits[:, 1]) for x in logs]
    target = [np.log(s.errors + FLOORS[unit]) for s in samples]
    weights = _weights(filled, target)
    blank = np.zeros(1)
    model = ErrorModel(unit, names, weights, limits, blank, blank, blank, (1, 1, 1))
    score = np.concatenate([scores_of(model, s.figures) for s in samples])
    share = np.concatenate([np.full(len(s.errors), 1 / len(s.errors)) for s in samples])
    errors = np.maximum(np.concatenate([s.errors for s in samples]), LEAST[unit])
    knots, typical, bound = _table(score, errors, share)
    return replace(model, scores=knots, typical=typical, bound=bound)


def _proportional(names: tuple[str, ...], unit: Unit, samples: Sequence[Sample]) -> ErrorModel:
    """Fit errors that are proportional to the one figure: a stage's own deviation."""
    ratios = np.concatenate([s.errors / s.figures[names[0]] for s in samples])
    share = np.concatenate([np.full(len(s.errors), 1 / len(s.errors)) for s in samples])
    typical, bound = (np.log([_quantile(ratios, share, q)]) for q in (0.5, NOMINAL))
    wide = np.array([[np.log(TINY), -np.log(TINY)]])
    return ErrorModel(unit, names, np.ones(1), wide, np.zeros(1), typical, bound, (1, 1, 1))


def _logarithms(sample: Sample, names: Sequence[str]) -> np.ndarray:
    """Return the logarithms (N, F) of a sample's figures; NaN where not finite."""
    columns = np.stack([sample.figures[name] for name in names], 1)
    return np.where(np.isfinite(columns), np.log(np.maximum(columns, TINY)), np.nan)


def _weights(logs: Sequence[np.ndarray], target: Sequence[np.ndarray]) -> np.ndarray:
    """Fit weights (F,) of figures (N, F) per item to the logarithms of errors (N,) per item."""
    within = np.mean([x.var(0) for x in logs], axis=0)
    means = np.stack([x.mean(0) for x in logs])
    between = means.var(0)
    own = within > ROW_LEVEL * (within + between) + 1e-9
    rest = ~own & (between > 1e-9)
    weights = np.zeros(len(within))
    moved = [(x - x.mean(0))[:, own] for x in logs]
    normal = np.mean([x.T @ x / len(x) for x in moved], axis=0) + RIDGE * np.eye(own.sum())
    right = [x.T @ (y - y.mean()) / len(x) for x, y in zip(moved, target, strict=True)]
    weights[own] = np.linalg.solve(normal, np.mean(right, axis=0))
    left = np.array([y.mean() for y in target]) - means @ weights
    x = (means - means.mean(0))[:, rest]
    normal = x.T @ x / len(x)
    normal += ROW_RIDGE * np.diag(np.diag(normal))
    weights[rest] = np.linalg.solve(normal, x.T @ (left - left.mean()) / len(x))
    return weights


def _table(
    score: np.ndarray, errors: np.ndarray, share: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return knots of the score and the logarithms of median and bound there, both rising."""
    order = np.argsort(score, kind="stable")
    place = np.cumsum(share[order])
    count = int(np.clip(len(score) // LEAST_ELEMENTS, 1, KNOTS))
    bins = np.minimum((place / place[-1] * count).astype(int), count - 1)
    rows = [
        (
            np.average(score[mine], weights=share[mine]),
            _quantile(errors[mine], share[mine], 0.5),
            _quantile(errors[mine], share[mine], NOMINAL),
        )
        for mine in (order[bins == k] for k in range(count))
        if len(mine)
    ]
    knots, typical, bound = np.array(rows).T
    kept = np.r_[True, np.diff(knots) > 1e-9]
    typical, bound = (np.log(isotonic_regression(v[kept]).x) for v in (typical, bound))
    return knots[kept], typical, bound


def _quantile(values: np.ndarray, weights: np.ndarray, level: float) -> float:
    """Return a weighted quantile of values (N,)."""
    order = np.argsort(values)
    place = np.cumsum(weights[order]) / weights.sum()
    row = min(int(np.searchsorted(place, level)), len(values) - 1)
    return float(values[order[row]])


def ause(errors: np.ndarray, doubt: np.ndarray) -> float:
    """Return the sparsification error of a doubt (N,) about errors (N,).

    It is the area between the mean errors that are left as the most doubted elements are taken
    away, and those left as the worst are, over the mean error (Ilg et al. 2018).
    """
    kept = np.maximum((np.linspace(1, 1 / 50, 50) * len(errors)).astype(int), 1)

    def left(key: np.ndarray) -> np.ndarray:
        total = np.cumsum(errors[np.argsort(key, kind="stable")])
        return total[kept - 1] / kept

    return float(np.mean(left(doubt) - left(errors)) / max(errors.mean(), 1e-12))
