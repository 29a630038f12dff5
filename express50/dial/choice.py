"""Choose settings: predict time and errors of the whole chain from a pilot, and say why.

A cheaper setting of one stage is assumed to change a result independently of the other stages.
Squared differences add up, on top of the error that remains at the most expensive settings. What
remains follows from the errors that stages state; where no stage states one, only the differences
are known.

The law of an item's seconds is a constant (libraries, the head model) plus a part proportional to
the sizes that the stage names in its `Growth`. Two sizes determine both; from one, only the
proportional part follows. Of three or more sizes, those near the one in question count most.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from express50.console import count, format_seconds, format_table
from express50.contract.stage import Stage
from express50.dial.budget import Goal
from express50.dial.figures import Cost, Footage, PilotFigures, Trial
from express50.dial.pilot import Ladder, standard_of
from express50.dial.results import RESULTS, ResultKind
from express50.errors import ConfigError, rounded

DRAWS = 400
LEAST_SPREAD = 0.05  # of a mean: machines vary as much from day to day
ASSUMED_SPREAD = 0.15  # of an item's seconds, as a share, if no size has two items
STATES = 400  # partial choices that are kept; far more than a front has points


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
    """Predict the seconds of an item as `forecast` does, but quickly and without an interval."""
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
    """Fit constant and slope, neither below 0 if bounded, by weighted least squares.

    Errors count as larger with the distance from `at`, because few stages follow the law exactly.
    """
    weights = 1 / (errors * (1 + np.log(works / at) ** 2))
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


@dataclass(frozen=True)
class Expected:
    """A result's expected error: value and interval.

    Where no stage states this error, all three are the difference from the result of the most
    expensive settings tried.
    """

    value: float
    low: float
    high: float
    unit: str
    stated: bool  # whether a stage states this error


@dataclass(frozen=True)
class Point:
    """A choice of settings."""

    settings: dict[str, str]  # name of each stage's setting
    seconds: float  # clock or core seconds for all items that are not made yet
    each: dict[str, float]  # the same per stage
    worse: float  # sum of the results' errors, relative to those at the most expensive settings
    errors: dict[str, Expected]  # expected error of each result


@dataclass(frozen=True, kw_only=True)
class Workload:
    """The work of a run."""

    stages: Sequence[Stage]  # the stages, in order
    ladders: Mapping[str, Ladder]  # settings of each stage, cheapest first
    measured: PilotFigures  # figures of the pilot
    footage: Footage  # size of all the footage to process
    width: int  # number of items processed in parallel
    cores: bool  # True if core seconds count instead of clock seconds
    fixed: Mapping[str, str] = field(default_factory=dict)  # settings of stages that have begun
    # what is made already, by the run or by a trial: per stage, the setting and the share of items
    done: Sequence[Mapping[str, tuple[str, float]]] = ()
    kinds: Sequence[ResultKind] = RESULTS  # results of the chain


def cost_at(load: Workload, name: str, label: str) -> tuple[Cost, Trial] | None:
    """Find what a stage cost in the pilot, and in which trial; None if it was not measured."""
    trials = load.measured.trials
    for trial in trials:
        whole = trial.footage.expressions == trials[0].footage.expressions
        ran = trial.settings[name] == label and name not in trial.failed
        if whole and ran and name in trial.costs:
            return trial.costs[name], trial
    return None


def labels_of(load: Workload, name: str) -> list[str]:
    """List the settings of a stage to choose from, cheapest first: those that were measured."""
    if name in load.fixed:
        return [load.fixed[name]]
    if name not in load.measured.losses:
        return [standard_of(load.ladders[name])]
    tried = [label for label in load.ladders[name] if cost_at(load, name, label)]
    return tried or [standard_of(load.ladders[name])]


def item_seconds(load: Workload, stage: Stage, label: str) -> tuple[int, float]:
    """Return how many items a stage has, and seconds of one at a setting."""
    name, first = stage.name, load.measured.trials[0]
    found = cost_at(load, name, label) or cost_at(load, name, first.settings[name])
    if found is None:
        return max(1, round(load.footage.items(stage.growth))), 0.0
    cost, trial = found
    whole = first if name in first.costs else trial  # other trials make only what changes
    share = whole.costs[name].items / max(whole.footage.items(stage.growth), 1e-9)
    count = max(1, round(share * load.footage.items(stage.growth)))
    samples = sizes_of(load.measured, stage)
    # What reduced pictures save was measured, see `size_factor`.
    recorded = replace(load.footage, side=trial.footage.side, every=trial.footage.every)
    work = [footage.time(stage.growth) for footage in (recorded, trial.footage)]
    grown = typical_seconds(samples, work[0]) / typical_seconds(samples, work[1])
    return count, (cost.core_seconds if load.cores else cost.seconds) * grown


def taken_over(load: Workload, trial: Trial) -> dict[str, tuple[str, float]]:
    """Return, by stage, a trial's setting and the share of the items that a run takes from it.

    An item that covers all expressions or all subjects differs if the trial had fewer of them, and
    so does everything after it.
    """
    seen = trial.footage
    whole = {"subjects": load.footage.subjects, "expressions": trial.scripted}
    found, fewer = {}, {name for name, size in whole.items() if getattr(seen, name) < size}
    for stage in load.stages:
        if stage.name in trial.failed or fewer & {*stage.growth.time}:
            break
        if stage.name in trial.costs:
            label = trial.settings[stage.name]
            items = item_seconds(load, stage, label)[0]
            found[stage.name] = label, min(1.0, trial.costs[stage.name].items / items)
    return found


def sizes_of(measured: PilotFigures, stage: Stage) -> list[MeasuredSize]:
    """Return what an item of a stage cost on the footage of both sizes that the pilot tried."""
    base, *others = measured.trials
    small = [t for t in others if t.footage.expressions < base.footage.expressions]
    return [
        MeasuredSize(t.footage.time(stage.growth), [t.costs[stage.name].core_seconds])
        for t in (base, *small[:1]) if stage.name in t.costs
    ] or [MeasuredSize(base.footage.time(stage.growth), [1.0])]  # fmt: skip


def size_factor(load: Workload, stage: Stage, settings: Mapping[str, str]) -> float:
    """Return how many times as long a stage takes on pictures of the size that settings choose.

    The base is the first trial. Trials of the stages that reduce pictures measured it.
    """
    base, factor = load.measured.trials[0], 1.0
    for earlier in load.stages:
        label = settings.get(earlier.name, base.settings[earlier.name])
        if earlier is stage:
            break
        if not earlier.growth.reduces or label == base.settings[earlier.name]:
            continue
        found = cost_at(load, earlier.name, label)
        costs = [trial.costs.get(stage.name) for trial in (found[1], base)] if found else []
        seconds = [cost.core_seconds for cost in costs if cost is not None]
        if len(seconds) == 2 and min(seconds) > 0:
            factor *= seconds[0] / seconds[1]
    return factor


def stage_seconds(load: Workload, stage: Stage, label: str, left: float = 1.0) -> float:
    """Return the seconds of a stage at a setting, for the share of its items that is left."""
    count, seconds = item_seconds(load, stage, label)
    count = math.ceil(count * left - 1e-9)
    if count == 0 or load.cores:
        return count * seconds
    first = load.measured.trials[0].costs.get(stage.name)
    return count * seconds / min(load.width, count) + (first.extra if first else 0.0)


def remaining_error(load: Workload, result: str) -> tuple[float, float, float] | None:
    """Return the squared error at the most expensive settings, and its interval as two ratios.

    None if no stage states this error.
    """
    losses = load.measured.losses
    trials = [trial for trial in load.measured.trials if result in trial.errors]
    if not trials:
        return None
    stated, low, high = np.array([trial.errors[result] for trial in trials]).T
    known = stated > 0
    ratios = [np.median(end[known] / stated[known]) if known.any() else 1.0 for end in (low, high)]
    lost = [
        sum(row.get(t.settings[name], {}).get(result, 0.0) ** 2 for name, row in losses.items())
        for t in trials
    ]
    return remaining_square(stated**2, np.array(lost)), float(ratios[0]), float(ratios[1])


def remaining_square(stated: np.ndarray, lost: np.ndarray) -> float:
    """Return the squared error where nothing is lost, from the squares of N trials (N,).

    Two settings may differ by as much as both are wrong, and be equally wrong. Therefore `lost`
    counts only as far as the stated errors fall with it.
    """
    away = lost - lost.mean()
    if not away.any():
        return float(np.median(stated))
    slope = away @ stated / (away @ away)
    share = max(0.0, min(1.0, slope, (stated[lost > 0] / lost[lost > 0]).min()))
    return float(np.median(stated - share * lost))


def expected_errors(load: Workload, lost: Mapping[str, float]) -> dict[str, Expected]:
    """Return the errors that follow from squared differences of the results."""
    found = {}
    for kind in load.kinds:
        rest = remaining_error(load, kind.name)
        if rest is not None:
            value = math.sqrt(rest[0] + lost.get(kind.name, 0.0))
            low, high = (value * ratio for ratio in rest[1:])
            if not rest[0]:  # the interval of an error of 0 is the stated one
                stated = [
                    t.errors[kind.name] for t in load.measured.trials if kind.name in t.errors
                ]
                low, high = min(e[1] for e in stated), max(e[2] for e in stated)
            found[kind.name] = Expected(value, min(low, value), max(high, value), kind.unit, True)
        elif kind.name in lost:
            value = math.sqrt(lost[kind.name])
            found[kind.name] = Expected(value, value, value, kind.unit, False)
    return found


class _State(NamedTuple):
    """What settings of the first stages take and lose."""

    settings: dict[str, str]  # of these stages
    each: dict[str, float]  # seconds by stage
    lost: dict[str, float]  # squares by result
    kept: frozenset[int]  # those of `Workload.done` made with the same settings up to here


def front(load: Workload) -> list[Point]:
    """Return the choices that no other beats in time and error, the quickest first."""
    scale = scales(load)
    reducing = [stage.name for stage in load.stages if stage.growth.reduces]
    states = [_State({}, {}, dict.fromkeys(scale, 0.0), frozenset(range(len(load.done))))]
    for stage in load.stages:
        there = [made.get(stage.name, ("", 0.0)) for made in load.done]
        losses, grown = load.measured.losses.get(stage.name, {}), []
        for label in labels_of(load, stage.name):
            left = {share: stage_seconds(load, stage, label, 1.0 - share) for _, share in there}
            left[0.0] = stage_seconds(load, stage, label)
            more = losses.get(label, {})
            for state in states:
                kept = frozenset(n for n in state.kept if there[n][0] == label)
                seconds = left[max((there[n][1] for n in kept), default=0.0)]
                lost = {r: value + more.get(r, 0.0) ** 2 for r, value in state.lost.items()}
                seconds *= size_factor(load, stage, state.settings)
                each = {**state.each, stage.name: seconds}
                grown.append(_State({**state.settings, stage.name: label}, each, lost, kept))
        states = _best(grown, scale, reducing)
    points = []
    for state in states:
        errors, seconds = expected_errors(load, state.lost), sum(state.each.values())
        worse = sum(errors[name].value / size for name, size in scale.items())
        points.append(Point(state.settings, seconds, state.each, worse, errors))
    points.sort(key=lambda p: (p.seconds, p.worse))
    kept_points: list[Point] = []
    for point in points:
        if not kept_points or point.worse < kept_points[-1].worse - 1e-9:
            kept_points.append(point)
    return kept_points


def scales(load: Workload) -> dict[str, float]:
    """Return the unit that a result's error is counted in: the error at the best settings.

    If that is 0, as for peaks that are right to the frame, it is the largest difference. Results
    that no setting changes are left out.
    """
    found = {}
    for kind in load.kinds:
        changes = [
            row.get(kind.name, 0.0) for ladder in load.measured.losses.values()
            for row in ladder.values()
        ]  # fmt: skip
        rest = remaining_error(load, kind.name)
        size = math.sqrt(rest[0]) if rest and rest[0] else max(changes, default=0.0)
        if any(changes):
            found[kind.name] = max(size, 1e-12)
    return found


def _best(
    states: list[_State], scale: Mapping[str, float], reducing: Sequence[str]
) -> list[_State]:
    """Drop partial choices that another one beats in time and in every result.

    Only choices of one size of pictures are compared: smaller ones save time in later stages.
    """
    states.sort(key=lambda s: (sum(s.each.values()), sum(s.lost[r] / scale[r] ** 2 for r in scale)))
    kept: list[_State] = []
    for state in states:
        beaten = any(
            other.kept >= state.kept
            and all(other.lost[r] <= state.lost[r] for r in scale)
            and all(other.settings.get(n) == state.settings.get(n) for n in reducing)
            for other in kept
        )
        if not beaten:
            kept.append(state)
    return kept[:STATES]


def point_of(load: Workload, settings: Mapping[str, str]) -> Point:
    """Predict time and errors of given settings."""
    (point,) = front(replace(load, fixed=settings))
    return point


def check_unit(kinds: Sequence[ResultKind], goal: Goal) -> None:
    """Raise ConfigError if no result of a chain has a goal's unit."""
    by_unit: dict[str, list[str]] = {}
    for kind in kinds:
        by_unit.setdefault(kind.unit, []).append(kind.name)
    if goal.unit not in by_unit:
        units = "; ".join(f"{unit} ({', '.join(names)})" for unit, names in by_unit.items())
        raise ConfigError(f"--error {goal.text}: expected one of these units: {units}")


def goal_result(load: Workload, goal: Goal) -> str:
    """Return the first result whose error has a goal's unit; ConfigError if no stage states it."""
    for kind in load.kinds:
        if kind.unit == goal.unit and remaining_error(load, kind.name) is not None:
            return kind.name
    raise ConfigError(
        f"--error {goal.text}: no stage could state an error in {goal.unit} on this footage; give"
        " --budget instead"
    )


def choose(points: Sequence[Point], seconds: float, goal: tuple[str, float] | None) -> Point:
    """Return the best point within the time; with a goal, the quickest that reaches it.

    If no point fits, return the quickest.
    """
    fitting = [point for point in points if point.seconds <= seconds] or [points[0]]
    if goal is not None:
        name, value = goal
        reaching = [p for p in fitting if p.errors[name].value <= value]
        if reaching:
            return reaching[0]
    return fitting[-1]


def error_text(name: str, error: Expected) -> str:
    """Write an expected error for people."""
    text = f"{name} {rounded(error.value)} {error.unit}"
    return f"{text} ({rounded(error.low)} to {rounded(error.high)})" if error.stated else text


def choice_lines(load: Workload, point: Point, asked: str, spent: float) -> Iterator[str]:
    """Yield what is expected of a choice, and why each setting was chosen.

    `asked` is the budget and the goal, for people.
    """
    kind = "core time" if load.cores else count(load.width, "worker")
    yield f"{asked}, {kind}: {format_seconds(spent)} spent on measuring"
    others = "difference from the most expensive settings (no stage states these errors)"
    for stated, words in ((True, "expected error"), (False, others)):
        texts = [error_text(n, e) for n, e in point.errors.items() if e.stated == stated]
        if texts:
            yield f"{words}: {', '.join(texts)}"
    yield f"done in {format_seconds(spent + point.seconds)}, measuring included"
    rows = []
    for stage in load.stages:
        label, seconds = point.settings[stage.name], point.each[stage.name]
        made = not seconds and cost_at(load, stage.name, label) is not None  # by a trial
        time = "made already" if made else format_seconds(seconds)
        rows.append([stage.name, label, time, _why(load, stage, point)])
    yield from format_table(["stage", "setting", "time", "why"], rows)


def _why(load: Workload, stage: Stage, point: Point) -> str:
    """Say what the neighbouring settings of a stage would cost or gain."""
    name, label = stage.name, point.settings[stage.name]
    ladder = list(load.ladders[name])
    if len(ladder) == 1:
        return "only one setting"
    if name not in load.measured.losses:
        return "standard, as no measured error depends on it"
    if cost_at(load, name, label) is None:
        why = next((t.failed[name] for t in load.measured.trials if name in t.failed), "no time")
        return f"not measured: {why}"
    here, tried = ladder.index(label), labels_of(load, name)
    words, untried = [], [other for other in ladder if other not in tried]
    for other in (*reversed(ladder[:here]), *ladder[here + 1 :]):
        if other in tried:
            instead = point_of(load, {**point.settings, name: other})
            seconds = instead.each[name] - point.each[name]
            time = f"{format_seconds(abs(seconds))} {'more' if seconds > 0 else 'less'}"
            words.append(f"{other}: {time}, {_change(load, name, label, other, point)}")
    configs, alike = load.ladders[name], []
    if stage.growth.reduces:
        size = {n: load.footage.after(stage.growth, c).picture for n, c in configs.items()}
        alike = [other for other in untried if size[other] == size[label]]
    if alike:
        words.append(f"{', '.join(alike)}: the same, as no recorded picture is larger")
    if untried := [one for one in untried if one not in alike]:
        words.append(f"{', '.join(untried)}: not tried")
    return "; ".join(words)


def _change(load: Workload, name: str, label: str, other: str, point: Point) -> str:
    """Say how another setting of a stage changes the result that it changes most."""
    losses, sizes = load.measured.losses[name], scales(load)
    most, words = 0.005, "same errors"
    for result, error in point.errors.items():
        squares = [losses.get(one, {}).get(result, 0.0) ** 2 for one in (label, other)]
        changed = math.sqrt(max(0.0, error.value**2 - squares[0] + squares[1]))
        share = abs(changed - error.value) / sizes.get(result, math.inf)
        if share > most:
            most = share
            words = f"{result} {changed - error.value:+.2g} {error.unit}"
    return words
