"""Run the whole chain within a budget: measure, choose, say what to expect, keep to it.

What is chosen and what is spent stands in ``dial/run.json``. A run that is stopped goes on with the
same choices within the same budget. Before each stage the rest is chosen anew with the speed seen
so far; a stage that has begun keeps its setting.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from express50.console import count, format_seconds, format_table
from express50.contract.config import config_toml
from express50.contract.layout import Dataset, exclusion_reason
from express50.contract.stage import Stage
from express50.dial.budget import Budget, Clock, Goal
from express50.dial.choice import (
    Expected,
    Point,
    Workload,
    choose,
    cost_at,
    front,
    goal_result,
    item_seconds,
    labels_of,
    scales,
    stage_seconds,
)
from express50.dial.figures import PilotFigures, dial_dir, read_measured
from express50.dial.footage import Footage, footage_of
from express50.dial.pilot import (
    Ladder,
    Pilot,
    broken_stage,
    keep_for_run,
    key_of,
    measure,
    pilot_dir,
    stated_errors,
)
from express50.dial.results import RESULTS, ResultKind
from express50.errors import ConfigError, FormatError, StageError
from express50.files.atomic import write_json
from express50.files.text import read_json_table
from express50.runner.executor import Pool
from express50.runner.ledger import Ledger
from express50.runner.runner import Summary, run_stage

PILOT_SHARE = 0.1  # of the budget, for trials that are not what the run makes anyway
SAFETY = 0.95  # of the time left is planned with: what items take varies
BELIEVED = 0.1  # of the expected time must have passed before its speed changes choices
PILOTS = 3  # subjects whose footage is tried, where that of the first is bad


@dataclass(frozen=True, kw_only=True)
class RunState:
    """A budgeted run, as stored.

    Attributes:
        key: of what was measured.
        budget: as it was written; empty with a goal alone.
        goal: as it was written, or empty.
        spent: seconds, of the clock or of all cores.
        settings: name of the setting of each stage.
        begun: stages that have begun, which keep their setting.
        promised: expected error of each result, as said before the start.
        seconds: expected then.
        changes: what was chosen anew later, and why.
        stated: ``[value, low, high]`` of each result, as the stages state in the end.
        finished: whether nothing was left.
    """

    key: str
    budget: str
    goal: str
    spent: float = 0.0
    settings: dict[str, str] = field(default_factory=dict)
    begun: list[str] = field(default_factory=list)
    promised: dict[str, dict[str, Any]] = field(default_factory=dict)
    seconds: float = 0.0
    changes: list[str] = field(default_factory=list)
    stated: dict[str, list[float]] = field(default_factory=dict)
    finished: bool = False


@dataclass
class Chain:
    """The stages of a dataset with their settings, and the workers that run them.

    Attributes:
        stages: in order.
        dataset: the dataset.
        ladders: settings of each stage.
        pool: workers.
        tell: takes lines for people.
        kinds: results that are measured.
    """

    stages: Sequence[Stage]
    dataset: Dataset
    ladders: Mapping[str, Ladder]
    pool: Pool
    tell: Callable[[str], None]
    kinds: Sequence[ResultKind] = RESULTS

    def key(self) -> str:
        """Return the digest of what measured figures depend on."""
        return key_of(self.stages, self.ladders, self.pool.threads)

    def measured(self, clock: Clock, allowance: float) -> PilotFigures:
        """Read what was measured of this dataset, or measure it.

        Raises:
            StageError: there is no footage that can be measured.
        """
        path = dial_dir(self.dataset) / "measured.json"
        found = read_measured(path, self.key())
        if found is not None and (allowance < math.inf or not found.untried):
            return found
        subjects = [s for s in self.dataset.captures() if not exclusion_reason(self.dataset, s)]
        if not subjects:
            raise StageError(f"{self.dataset.root}: no capture is registered; name a CAPTURE")
        reason = ""
        for subject in subjects[:PILOTS]:
            pilot = Pilot(
                self.dataset, subject, self.stages, self.ladders, self.pool, clock, self.tell,
                self.kinds,
            )  # fmt: skip
            found = measure(pilot, allowance)
            broken = broken_stage(pilot, found.trials[0])
            reason = f"{broken}: {found.trials[0].failed[broken]}" if broken else ""
            if not reason or clock.closed():
                break
            self.tell(f"{subject} cannot be measured: {reason}")
        if found is None or reason:
            raise StageError(
                f"{self.dataset.root}: no subject could be measured: {reason}; correct that, or "
                "run without --budget to see what each stage says"
            )
        if not clock.closed():  # folders of trials go; no figure names a person
            trials = [replace(trial, folder="") for trial in found.trials]
            write_json(path, asdict(replace(found, trials=trials)))
        return found

    def workload(self, measured: PilotFigures, cores: bool, begun: Mapping[str, str]) -> Workload:
        """Describe what is left to make."""
        footage = self.footage(measured)
        load = Workload(
            stages=self.stages, ladders=self.ladders, measured=measured, footage=footage,
            width=self.pool.width(), cores=cores, fixed=begun, kinds=self.kinds,
        )  # fmt: skip
        return replace(load, done={stage.name: self._done(load, stage) for stage in self.stages})

    def footage(self, measured: PilotFigures) -> Footage:
        """Return the size of all footage: as ingested, or like the pilot's for every capture."""
        captures = len(self.dataset.captures())
        if 0 < len(self.dataset.subjects()) >= captures:
            return footage_of(self.dataset)
        seen = measured.trials[0].footage
        scripted = measured.trials[0].scripted
        return replace(seen, subjects=float(captures), expressions=scripted)

    def _done(self, load: Workload, stage: Stage) -> tuple[str, float]:
        """Return the setting that a stage's folder was made with, and the share that is there."""
        path = self.dataset.config_file(stage.name)
        if not path.is_file() or not self.dataset.ledger.is_file():
            return "", 0.0
        text = path.read_text(encoding="utf-8", errors="replace")
        for label, config in self.ladders[stage.name].items():
            if config_toml(stage.name, config) == text:
                with Ledger(self.dataset.ledger, read_only=True) as ledger:
                    done = sum(r.status == "done" for r in ledger.read(stage.name).values())
                return label, min(1.0, done / item_seconds(load, stage, label)[0])
        return "", 0.0


def run_within(
    chain: Chain,
    budget: Budget | None,
    goal: Goal | None,
    ended: Callable[[Stage, Summary], None],
) -> tuple[list[Summary], RunState]:
    """Run the chain within a budget, or to a goal.

    Args:
        chain: stages, dataset and workers.
        budget: time, or None for as long as the goal takes.
        goal: error of a result, or None for the least in the time.
        ended: called with each stage's account.

    Raises:
        ConfigError: the budget does not cover the cheapest settings, or no setting reaches the
            goal; the sentence says what would.
        StageError: nothing can be measured.
    """
    path = dial_dir(chain.dataset) / "run.json"
    state = _resumed(path, chain.key(), budget, goal)
    clock = Clock(budget, spent=state.spent)

    def keep(spent: float) -> None:
        write_json(path, asdict(replace(state, spent=spent)))

    clock.keep = keep
    allowance = PILOT_SHARE * budget.seconds if budget else math.inf
    measured = chain.measured(clock, allowance)
    cores = budget is not None and budget.cores
    begun = {name: state.settings[name] for name in state.begun}
    load = chain.workload(measured, cores, begun)
    wanted = (goal_result(load, goal), goal.value) if goal is not None else None
    if not state.settings:
        point = _first_choice(load, clock, goal)
        state = replace(
            state, settings=point.settings, seconds=clock.now() + point.seconds,
            promised={name: asdict(error) for name, error in point.errors.items()},
        )  # fmt: skip
        keep_for_run(chain.dataset, point.settings)
        for line in choice_lines(load, point, budget, clock.now()):
            chain.tell(line)
    else:
        chain.tell(
            f"going on: {format_seconds(clock.now())} of the budget are spent; settings as chosen"
        )
    keep(clock.now())
    summaries = []
    speed = _Speed(believed=max(1.0, BELIEVED * (state.seconds - state.spent)))
    for stage in chain.stages:
        state = _choose_rest(chain, measured, clock, state, stage, speed, wanted, cores)
        keep(clock.now())
        summary = _run_one(chain, measured, clock, state, stage, speed, cores)
        if summary is None:
            break
        summaries.append(summary)
        ended(stage, summary)
    whole = len(summaries) == len(chain.stages) and not any(s.count("left") for s in summaries)
    names = [stage.name for stage in chain.stages]
    stated = stated_errors(chain.dataset, names, chain.kinds) if summaries else {}
    state = replace(state, finished=whole, spent=clock.now(), stated=stated)
    keep(clock.now())
    if whole:
        shutil.rmtree(pilot_dir(chain.dataset), ignore_errors=True)
    return summaries, state


def _resumed(path: Path, key: str, budget: Budget | None, goal: Goal | None) -> RunState:
    """Read the run that is to go on, or begin one: another budget or goal is another run."""
    fresh = RunState(key=key, budget=budget.text if budget else "", goal=goal.text if goal else "")
    if not path.is_file():
        return fresh
    try:
        state = RunState(**read_json_table(path, FormatError, "delete it to choose anew"))
    except TypeError as error:
        raise FormatError(f"{path}: not a run ({error}); delete it to choose anew") from error
    same = (state.key, state.budget, state.goal) == (fresh.key, fresh.budget, fresh.goal)
    return state if same else fresh


def _first_choice(load: Workload, clock: Clock, goal: Goal | None) -> Point:
    wanted = (goal_result(load, goal), goal.value) if goal is not None else None
    points = front(load)
    left = clock.left()
    if clock.closed() or points[0].seconds > left:
        least = clock.now() + points[0].seconds
        words = "core time" if load.cores else f"with {count(load.width, 'worker')}"
        raise ConfigError(
            f"--budget {clock.budget.text if clock.budget else ''}: the cheapest settings need "
            f"about {format_seconds(least)} {words}, {format_seconds(clock.now())} of them for "
            f"measuring, which is kept; give --budget {budget_text(1.1 * least, load.cores)} or"
            " more"
        )
    point = choose(points, left * SAFETY, wanted)
    if goal is not None and wanted is not None and point.errors[wanted[0]].value > goal.value:
        name = wanted[0]
        reaching = [p for p in points if p.errors[name].value <= goal.value]
        if reaching:
            need = format_seconds(clock.now() + reaching[0].seconds)
            how = f"takes about {need}, which is more than --budget"
        else:
            how = f"the most expensive settings give {error_text(name, points[-1].errors[name])}"
        raise ConfigError(f"--error {goal.text}: {how}")
    return point


def budget_text(seconds: float, cores: bool) -> str:
    """Write seconds as a budget, rounded up."""
    if cores:
        return f"{math.ceil(seconds / 36) / 100:g}ch"
    if seconds < 120:
        return f"{math.ceil(seconds)}s"
    return f"{math.ceil(seconds / 60)}m" if seconds < 36000 else f"{math.ceil(seconds / 3600)}h"


@dataclass
class _Speed:
    """How long stages took, compared with what was expected; used after ``believed`` seconds."""

    believed: float
    real: float = 0.0
    expected: float = 0.0

    def ratio(self) -> float:
        """Return the ratio, 1 while too little was seen."""
        if self.expected < self.believed:
            return 1.0
        return min(4.0, max(0.5, self.real / self.expected))


def _choose_rest(
    chain: Chain,
    measured: PilotFigures,
    clock: Clock,
    state: RunState,
    stage: Stage,
    speed: _Speed,
    wanted: tuple[str, float] | None,
    cores: bool,
) -> RunState:
    """Choose the settings of this and later stages anew where the time left asks for it."""
    if stage.name in state.begun:
        return state
    begun = {name: state.settings[name] for name in state.begun}
    points = front(chain.workload(measured, cores, begun))
    left = clock.left() / speed.ratio()
    now = next((p for p in points if p.settings == state.settings), None)
    better = choose(points, left * SAFETY, wanted)
    late = now is None or now.seconds > left
    changed = [n for n, label in better.settings.items() if label != state.settings[n]]
    if not changed or not (late or better.worse < (now.worse if now else math.inf)):
        return replace(state, begun=[*state.begun, stage.name])
    why = "behind" if late else "ahead of"
    moves = ", ".join(f"{n} {state.settings[n]} -> {better.settings[n]}" for n in changed)
    line = f"{why} time at {format_seconds(clock.now())}: {moves}"
    chain.tell(line)
    return replace(
        state,
        settings=better.settings,
        begun=[*state.begun, stage.name],
        changes=[*state.changes, line],
    )


def _run_one(
    chain: Chain,
    measured: PilotFigures,
    clock: Clock,
    state: RunState,
    stage: Stage,
    speed: _Speed,
    cores: bool,
) -> Summary | None:
    """Run a stage until the budget ends; None if it has nothing to work on."""
    load = chain.workload(measured, cores, {})
    label = state.settings[stage.name]
    config = chain.ladders[stage.name][label]
    items, item = item_seconds(load, stage, label)
    later = list(chain.stages)[list(chain.stages).index(stage) + 1 :]
    rest = sum(
        min(stage_seconds(load, other, one) for one in labels_of(load, other.name))
        for other in later
    )
    clock.expect(item * speed.ratio(), rest * speed.ratio() if clock.budget else 0.0)
    before = clock.now()
    if not stage.items(chain.dataset):  # an earlier stage made nothing
        return None
    summary = run_stage(stage, chain.dataset, config, pool=chain.pool, gate=clock)
    made = sum(o.status == "done" and not o.restored for o in summary.outcomes)
    if made:
        speed.real += clock.now() - before
        speed.expected += stage_seconds(load, stage, label, min(1.0, made / items))
    return summary


def error_text(name: str, error: Expected) -> str:
    """Write an expected error for people."""
    if not error.stated:
        return f"{name} {error.value:.2g} {error.unit}"
    return f"{name} {error.value:.2g} {error.unit} ({error.low:.2g} to {error.high:.2g})"


def expected_lines(point: Point) -> Iterator[str]:
    """Yield the errors to expect: those that stages state, and mere differences."""
    texts = {name: error_text(name, error) for name, error in point.errors.items()}
    stated = [text for name, text in texts.items() if point.errors[name].stated]
    others = [text for name, text in texts.items() if not point.errors[name].stated]
    if stated:
        yield f"expected error: {', '.join(stated)}"
    if others:
        words = "no stage states these errors; difference from the most expensive settings"
        yield f"{words}: {', '.join(others)}"


def choice_lines(
    load: Workload, point: Point, budget: Budget | None, spent: float
) -> Iterator[str]:
    """Yield what is expected of a choice, and why each setting was chosen."""
    kind = "core time" if load.cores else count(load.width, "worker")
    whole = f"budget {budget.text}" if budget else "no budget"
    yield f"{whole}, {kind}: {format_seconds(spent)} spent on measuring"
    yield from expected_lines(point)
    yield f"done in {format_seconds(spent + point.seconds)}, measuring included"
    rows = []
    for stage in load.stages:
        label = point.settings[stage.name]
        rows.append(
            [stage.name, label, format_seconds(point.each[stage.name]), _why(load, stage, point)]
        )
    yield from format_table(["stage", "setting", "time", "why"], rows)


def _why(load: Workload, stage: Stage, point: Point) -> str:
    """Say what the neighbouring settings of a stage would cost or gain."""
    name, label = stage.name, point.settings[stage.name]
    ladder = list(load.ladders[name])
    if len(ladder) == 1:
        return "has one setting"
    if name not in load.measured.losses:
        return "no measured error depends on it: standard"
    if cost_at(load, name, label) is None:
        why = next((t.failed[name] for t in load.measured.trials if name in t.failed), "no time")
        return f"not measured: {why}"
    here, tried = ladder.index(label), labels_of(load, name)
    words, untried = [], [other for other in ladder if other not in tried]
    for other in (*reversed(ladder[:here]), *ladder[here + 1 :]):
        if other in tried:
            seconds = stage_seconds(load, stage, other) - stage_seconds(load, stage, label)
            time = f"{format_seconds(abs(seconds))} {'more' if seconds > 0 else 'less'}"
            words.append(f"{other}: {time}, {_change(load, name, label, other, point)}")
    if untried:
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


def closing_lines(state: RunState, summaries: Sequence[Summary]) -> Iterator[str]:
    """Yield time spent, the errors that the stages state, and what is left."""
    whole = f" of {state.budget}" if state.budget else ""
    yield f"spent {format_seconds(state.spent)}{whole}, {format_seconds(state.seconds)} expected"
    for name, (value, low, high) in state.stated.items():
        unit, said = state.promised[name]["unit"], state.promised[name]["value"]
        yield f"{name}: {value:.2g} {unit} ({low:.2g} to {high:.2g}), {said:.2g} promised"
    left = [f"{s.count('left')} of {s.stage}" for s in summaries if s.count("left")]
    if not state.finished:
        what = ", ".join(left) or "later stages"
        yield f"the time is over; left: {what}; a larger --budget continues from here"
