"""Measure settings on a dataset, within a budget or all of them, and say what is left to make."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from express50.console import count, format_seconds, format_table
from express50.contract.config import PRESETS, made_with
from express50.contract.layout import exclusion_reason
from express50.dial.budget import Clock, Goal
from express50.dial.choice import (
    Point,
    Workload,
    choose,
    error_text,
    front,
    goal_result,
    item_seconds,
    labels_of,
    point_of,
    taken_over,
)
from express50.dial.figures import PilotFigures, Trial, dial_dir, footage_of, read_measured
from express50.dial.pilot import TRIAL_EXPRESSIONS, Chain, Pilot, broken_stage, measure, standard_of
from express50.errors import ConfigError, StageError, advised
from express50.files.atomic import write_csv, write_json
from express50.runner.ledger import Ledger

PILOT_SUBJECTS = 3  # most subjects that are tried, while the footage of each proves bad
BUSY_RATIO = 1.5  # clock time over processor time on all workers, above which much was waiting


def measured_figures(
    chain: Chain, clock: Clock, goal: Goal | None = None, chosen: bool = False
) -> PilotFigures:
    """Read what was measured of a chain's dataset, or measure it.

    Settings that there was no time to try are tried by the next run, unless its settings are
    ``chosen`` already. Trials that are still there are not run again.

    Raises:
        ConfigError: the budget ended before any footage was ingested, or no stage states an error
            in the goal's unit.
        StageError: no footage can be measured.
    """
    path = dial_dir(chain.dataset) / "measured.json"
    found = read_measured(path, chain.key())
    if found is not None and not chosen and not clock.cores and clock.budget is not None:
        load = workload(chain, found, False, {})
        least = front(load)[0]
        waited = least.seconds > BUSY_RATIO * core_seconds(load, least.settings) / load.width
        # Clock figures that are mostly waiting must not refuse a budget: other programs may have
        # slowed the trials of an earlier command, and may have ended since. Where the budget is not
        # refused, the run sees by itself that it is ahead of time.
        if waited and least.seconds > clock.left():
            found = _timed_again(chain, clock, found)
    if found is not None and (chosen or not found.untried):
        return found
    found = _measure_one(chain, clock, _Allowance(chain, clock, goal))
    write_json(path, asdict(found))
    return found


@dataclass(frozen=True)
class _Allowance:
    """Says how long trials may take, from what was measured so far."""

    chain: Chain
    clock: Clock
    goal: Goal | None

    def spare(self, figures: PilotFigures, guess: Trial | None = None) -> float:
        load, left = workload(self.chain, figures, self.clock.cores, {}), self.clock.plannable()
        points = front(load)
        wanted = None if self.goal is None else (goal_result(load, self.goal), self.goal.value)
        best = choose(points, left, wanted)
        seconds = best.seconds
        if guess is not None:
            changed = {n for n, s in guess.settings.items() if s != figures.trials[0].settings[n]}
            settings = best.settings | {name: guess.settings[name] for name in changed}
            more = replace(figures, trials=[*figures.trials, guess])
            seconds = point_of(workload(self.chain, more, self.clock.cores, {}), settings).seconds
        if wanted and best.errors[wanted[0]].value <= wanted[1]:
            # More trials can only find a quicker choice, and none is quicker than the cheapest.
            left = min(left, seconds + best.seconds - points[0].seconds)
        return left - seconds

    def doubtful(self, figures: PilotFigures) -> float:
        if self.clock.budget is None and self.goal is None:
            return math.inf  # `tune` measures everything, also for `plan`
        load = workload(self.chain, figures, self.clock.cores, {})
        first, seconds = figures.trials[0], 0.0
        for stage in load.stages:
            if stage.name in first.costs:
                items, each = item_seconds(load, stage, first.settings[stage.name])
                cost = first.costs[stage.name]
                tried = cost.core_seconds if load.cores else cost.seconds
                seconds += items * max(0.0, each - tried) / (1 if load.cores else load.width)
        return seconds


def core_seconds(load: Workload, settings: Mapping[str, str]) -> float:
    """Predict the processor seconds of given settings."""
    return point_of(replace(load, cores=True), settings).seconds


def _timed_again(chain: Chain, clock: Clock, found: PilotFigures) -> PilotFigures:
    """Run the first trial again; take other trials to have waited as much per processor second."""
    first = found.trials[0]
    pilots = [Pilot(chain, subject, clock) for subject in _subjects(chain)]
    pilots = [
        p for p in pilots if p.record(first.settings, TRIAL_EXPRESSIONS).parent.name == first.folder
    ]
    if not pilots:
        return found
    shutil.rmtree(chain.dataset.pilot_dir / first.folder, ignore_errors=True)
    words = "measuring again, as other programs may have slowed the machine when it was measured"
    try:
        base = pilots[0].trial(first.settings, TRIAL_EXPRESSIONS, None, words)
    except StageError:  # not even the footage was read in the time
        return found
    if pilots[0].cut or broken_stage(chain, base):
        return found
    trials = [base]
    for trial in found.trials[1:]:
        costs = dict(trial.costs)
        for name, now in base.costs.items():
            if name in costs and now.core_seconds > 0:
                seconds = costs[name].core_seconds * now.seconds / now.core_seconds
                costs[name] = replace(costs[name], seconds=seconds, extra=now.extra)
        trials.append(replace(trial, costs=costs))
    for trial in trials:
        record = chain.dataset.pilot_dir / trial.folder / "trial.json"
        if record.is_file():
            write_json(record, asdict(trial))
    found = replace(found, trials=trials)
    write_json(dial_dir(chain.dataset) / "measured.json", asdict(found))
    return found


def _subjects(chain: Chain) -> list[str]:
    """List the first subjects that are not excluded; StageError if there are none."""
    root, captures = chain.dataset.root, chain.dataset.captures()
    subjects = [s for s in captures if not exclusion_reason(chain.dataset, s)]
    if captures and not subjects:
        include = advised("express50 annotate include", root, min(captures))
        raise StageError(f"{root}: every subject is excluded; to include one: {include}")
    if not subjects:
        run = advised("express50 run", root, "CAPTURE")
        raise StageError(f"{root}: has no captures yet; run {run}")
    return subjects[:PILOT_SUBJECTS]


def _measure_one(chain: Chain, clock: Clock, allowance: _Allowance) -> PilotFigures:
    """Measure the first subject whose footage every stage can work on.

    Raises as `measured_figures` does.
    """
    subjects = _subjects(chain)
    for subject in subjects:
        try:
            pilot = Pilot(chain, subject, clock)
            found = measure(pilot, allowance.spare, allowance.doubtful)
            broken = broken_stage(chain, found.trials[0])
            if pilot.cut:
                least = clock.now() + front(workload(chain, found, clock.cores, {}))[0].seconds
                raise ConfigError(
                    f"--budget {clock.budget.text if clock.budget else ''}: it ended before every"
                    " stage was measured at its cheapest setting; measuring and running the"
                    f" measured stages alone takes {format_seconds(least)}"
                    f" {time_words(clock.cores, chain.pool.width())}; give several times as much."
                    " What was measured is kept, so the same command gets further each time"
                )
            if not broken:
                return found
            reason = f"{broken}: {found.trials[0].failed[broken]}"
        except StageError as error:  # nothing is ingested
            reason = str(error)
            if clock.budget is not None and clock.closed():
                raise ConfigError(
                    f"--budget {clock.budget.text}: the time ended before the footage of {subject}"
                    " was ingested; give more time"
                ) from error
        if subject != subjects[-1]:
            chain.tell(f"{subject} cannot be measured, trying the next subject: {reason}")
    raise StageError(
        f"{chain.dataset.root}: no subject could be measured: {reason}; correct that, or run"
        " without --budget to see what each stage says"
    )


def time_words(cores: bool, width: int) -> str:
    """Say what kind of time a budget counts."""
    return "core time" if cores else f"with {count(width, 'worker')}"


def workload(
    chain: Chain, measured: PilotFigures, cores: bool, begun: Mapping[str, str]
) -> Workload:
    """Describe what is left to make."""
    seen, captures = measured.trials[0], len(chain.dataset.captures())
    footage = replace(seen.footage, subjects=float(captures), expressions=seen.scripted)
    if 0 < len(chain.dataset.subjects()) >= captures:
        footage = footage_of(chain.dataset)
    load = Workload(
        stages=chain.stages, ladders=chain.ladders, measured=measured, footage=footage,
        width=chain.pool.width(), cores=cores, fixed=begun, kinds=chain.kinds,
    )  # fmt: skip
    dataset, made_here = chain.dataset, {}
    if dataset.ledger.is_file():
        with Ledger(dataset.ledger, read_only=True) as ledger:
            for stage in chain.stages:
                path, ladder = dataset.config_file(stage.name), load.ladders[stage.name]
                if (label := made_with(path, stage, ladder)) is not None:
                    done = [r for r in ledger.read(stage.name).values() if r.status == "done"]
                    made = sum(dataset.item_dir(stage.name, r.item).is_dir() for r in done)
                    share = min(1.0, made / item_seconds(load, stage, label)[0])
                    made_here[stage.name] = label, share
    there = [t for t in measured.trials if t.folder and (dataset.pilot_dir / t.folder).is_dir()]
    return replace(load, done=[made_here, *(taken_over(load, trial) for trial in there)])


def tune(chain: Chain) -> tuple[dict[str, Any], list[str]]:
    """Measure every setting on a few items; write ``dial/front.json`` and ``dial/front.csv``.

    Returns the table and lines for people.

    Raises:
        StageError: no footage can be measured.
    """
    measured = measured_figures(chain, Clock(None))
    load = replace(workload(chain, measured, False, {}), done=())
    points = front(load)
    presets = {preset: point_of(load, preset_settings(load, preset)) for preset in PRESETS}
    table = {
        "schema": "express50.front/1",
        "footage": asdict(load.footage),
        "workers": load.width,
        "front": [_row(load, point) for point in points],
        "presets": {name: _row(load, point) for name, point in presets.items()},
    }
    folder = dial_dir(chain.dataset)
    write_json(folder / "front.json", table)
    named = {str(number): point for number, point in enumerate(points)} | presets
    rows = []
    for name, point in named.items():
        errors = {
            f"{result}_{error.unit}{end}": f"{figure:.5g}"
            for result, error in point.errors.items()
            for end, figure in (("", error.value), ("_low", error.low), ("_high", error.high))
        }
        row = {"point": name, "seconds": f"{point.seconds:.1f}"}
        rows.append(row | errors | point.settings)
    write_csv(folder / "front.csv", list(rows[0]), rows)
    shutil.rmtree(chain.dataset.pilot_dir, ignore_errors=True)
    return table, [*_lines(load, points, presets), f"wrote {folder}/front.json and front.csv"]


def _row(load: Workload, point: Point) -> dict[str, Any]:
    return asdict(point) | {"core_seconds": core_seconds(load, point.settings)}


def preset_settings(load: Workload, preset: str) -> dict[str, str]:
    """Return the settings of a preset; standard's where a stage lacks it or it was not tried."""
    found = {}
    for stage in load.stages:
        tried = labels_of(load, stage.name)
        found[stage.name] = preset if preset in tried else standard_of(dict.fromkeys(tried))
    return found


def _lines(load: Workload, points: list[Point], presets: Mapping[str, Point]) -> list[str]:
    """Write the front for people: settings are those that change from one point to the next."""
    usual = preset_settings(load, "standard")
    rows = []
    for point in points:
        same = [name for name, one in presets.items() if one.settings == point.settings]
        changed = ", ".join(
            f"{n} {label}" for n, label in point.settings.items() if label != usual[n]
        )
        errors = [error_text(name, error).partition(" ")[2] for name, error in point.errors.items()]
        rows.append(
            [format_seconds(point.seconds), *errors, "/".join(same) or changed or "standard"]
        )
    head = ["time", *points[-1].errors, "settings that differ from standard"]
    beaten = [
        name for name, one in presets.items() if one.settings not in [p.settings for p in points]
    ]
    words = f"not on the front, as another choice is quicker and no worse: {', '.join(beaten)}"
    return [*format_table(head, rows), *([words] if beaten else [])]
