"""Run the whole chain within a budget: measure, choose, say what to expect, keep to it.

``dial/run.json`` holds what was chosen and what was spent. A run that was stopped continues with
the same choices within the same budget; one that was finished, with the whole budget again. Before
each stage the remaining settings are chosen again with the speed seen so far; a stage that has
begun keeps its setting.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from express50.console import format_seconds
from express50.contract.layout import Dataset
from express50.contract.stage import Stage
from express50.dial.budget import Budget, Clock, Goal, budget_text, parse_budget
from express50.dial.choice import (
    Point,
    Workload,
    check_unit,
    choice_lines,
    choose,
    error_text,
    front,
    goal_result,
    item_seconds,
    point_of,
    size_factor,
    stage_seconds,
)
from express50.dial.figures import PilotFigures, dial_dir
from express50.dial.measuring import (
    BUSY_RATIO,
    core_seconds,
    measured_figures,
    time_words,
    workload,
)
from express50.dial.pilot import Chain, keep_for_run, stated_errors
from express50.dial.results import RESULTS
from express50.errors import ConfigError, FormatError, rounded
from express50.files.atomic import write_json
from express50.files.text import read_json_table
from express50.runner.runner import Outcome, Summary, run_stage

BELIEVED_SHARE = 0.1  # of the expected time must have passed before its speed changes choices
GRACE = 0.1  # of the budget by which a run may end late rather than stop with nothing made


@dataclass(frozen=True, kw_only=True)
class RunState:
    """A budgeted run, as stored."""

    key: str  # `Chain.key` of what was measured
    budget: str  # as it was written; empty with a goal alone
    goal: str  # as it was written, or empty
    spent: float = 0.0  # seconds, of the clock or of all cores
    settings: dict[str, str] = field(default_factory=dict)  # name of the setting of each stage
    begun: list[str] = field(default_factory=list)  # begun stages, which keep their setting
    # expected error of each result, as said before the start
    promised: dict[str, dict[str, Any]] = field(default_factory=dict)
    seconds: float = 0.0  # expected before the start
    changes: list[str] = field(default_factory=list)  # what was chosen again later, and why
    # ``[value, low, high]`` of each result, as the stages state in the end
    stated: dict[str, list[float]] = field(default_factory=dict)
    finished: bool = False  # whether nothing was left
    rest: float = 0.0  # expected seconds of what was left


def run_file(dataset: Dataset) -> Path:
    """Return the path of the state of a dataset's budgeted run."""
    return dial_dir(dataset) / "run.json"


@dataclass
class _Run:
    """A run as it goes on."""

    chain: Chain
    clock: Clock
    state: RunState  # as stored
    measured: PilotFigures = field(init=False)  # of the pilot
    wanted: tuple[str, float] | None = None  # name of the result that has a goal, and the goal
    real: float = 0.0  # seconds that stages took so far
    expected: float = 0.0  # seconds that were expected of them

    def keep(self, **changes: Any) -> None:
        """Change the state, and store it with what is spent."""
        self.state = replace(self.state, **changes)
        write_json(
            run_file(self.chain.dataset), asdict(replace(self.state, spent=self.clock.now()))
        )

    def asked(self) -> str:
        """Write the budget, and the goal with the name of its result."""
        goal = f"error {self.state.goal} of the {self.wanted[0]}" if self.wanted else ""
        return ", ".join(filter(None, [self.state.budget and f"budget {self.state.budget}", goal]))

    def workload(self) -> Workload:
        """Describe what is left to make; stages that have begun keep their setting."""
        begun = {name: self.state.settings[name] for name in self.state.begun}
        return workload(self.chain, self.measured, self.clock.cores, begun)

    def slowness(self) -> float:
        """Return how much longer stages took than expected; 1 while too little was seen."""
        believed = max(1.0, BELIEVED_SHARE * (self.state.seconds - self.state.spent))
        if self.expected < believed:
            return 1.0
        return min(4.0, max(0.25, self.real / self.expected))


def run_within(
    chain: Chain, budget: Budget | None, goal: Goal | None, ended: Callable[[Stage, Summary], None]
) -> tuple[list[Summary], RunState]:
    """Run the chain within a budget, or to a goal.

    Without a budget, the run takes as long as the goal takes; without a goal, it looks for the
    least error in the time. `ended` is called with each stage's account.

    Raises:
        ConfigError: the budget does not cover the cheapest settings, or no setting reaches the
            goal; the sentence says what would.
        StageError: nothing can be measured.
    """
    if goal is not None:
        check_unit(chain.kinds, goal)
    state = RunState(
        key=chain.key(), budget=budget.text if budget else "", goal=goal.text if goal else ""
    )
    path, former = run_file(chain.dataset), None
    if path.is_file():
        try:
            former = RunState(**read_json_table(path, FormatError, "delete it to choose again"))
        except TypeError as error:
            raise FormatError(f"{path}: not a run ({error}); delete it to choose again") from error
        if (former.key, former.budget, former.goal) == (state.key, state.budget, state.goal):
            state = former
    again = state.finished  # for captures that were added since: they get the budget anew
    state = replace(state, spent=0.0, finished=False) if again else state
    clock = Clock(budget, spent=state.spent)
    run = _Run(chain, clock, state)
    clock.keep = run.keep
    try:
        return _measure_and_run(run, goal, again, ended)
    except KeyboardInterrupt:
        run.keep()  # the stopped item took time as well
        raise
    except ConfigError:  # measuring does not count again, and an earlier run keeps its choices
        if not run.state.settings:
            path.unlink(missing_ok=True)
            if former is not None and former.settings:
                write_json(path, asdict(former))
        raise


def _measure_and_run(
    run: _Run, goal: Goal | None, again: bool, ended: Callable[[Stage, Summary], None]
) -> tuple[list[Summary], RunState]:
    """Measure, choose settings unless they are chosen already, and run the stages."""
    chain, clock, state = run.chain, run.clock, run.state
    run.measured = measured_figures(chain, clock, goal, chosen=bool(state.settings))
    load = run.workload()
    run.wanted = None if goal is None else (goal_result(load, goal), goal.value)
    if not state.settings:
        point = _first_choice(run, load)
        promised = {name: asdict(error) for name, error in point.errors.items()}
        run.state = replace(
            state, settings=point.settings, seconds=clock.now() + point.seconds, promised=promised
        )
        keep_for_run(chain.dataset, point.settings, run.measured.trials)
        lines = choice_lines(load, point, run.asked(), clock.now())
    else:
        if again:
            run.state = replace(state, seconds=clock.now() + front(load)[0].seconds)
        spent = "with the whole budget again" if again else f"{format_seconds(clock.now())} spent"
        lines = iter([f"continuing with the chosen settings, {spent}"])
    for line in lines:
        chain.tell(line)
    run.keep()
    summaries: list[Summary] = []
    for stage in chain.stages:
        summary = _run_one(run, stage, summaries)
        if summary is None:
            break
        summaries.append(summary)
        ended(stage, summary)
    whole = len(summaries) == len(chain.stages) and not _any_left(summaries)
    stated = stated_errors(chain, chain.dataset) if summaries else {}
    rest = 0.0
    if not whole:  # at the speed that was seen
        rest = run.slowness() * point_of(run.workload(), run.state.settings).seconds
    run.state = replace(run.state, spent=clock.now())
    run.keep(finished=whole, stated=stated, rest=rest)
    if whole and not run.measured.untried:  # else a larger budget goes on with them
        shutil.rmtree(chain.dataset.pilot_dir, ignore_errors=True)
    return summaries, run.state


def _first_choice(run: _Run, load: Workload) -> Point:
    clock, points = run.clock, front(load)
    if clock.budget is not None and points[0].seconds > max(0.0, clock.left()):
        spent, least = clock.now(), points[0].seconds
        words = time_words(load.cores, load.width)
        give = f"give --budget {budget_text(1.1 * least, load.cores)} or more"
        if 1.1 * least <= clock.budget.seconds:
            give = "the same command again will do"
        core = core_seconds(load, points[0].settings)
        if not load.cores and least > BUSY_RATIO * core / load.width:
            give += f"; only {format_seconds(core)} of it is processor time: where other programs"
            give += f" slowed the measuring, give --budget {budget_text(1.1 * core, True)} instead"
        raise ConfigError(
            f"--budget {clock.budget.text}: the cheapest settings need about"
            f" {format_seconds(least)} {words} after {format_seconds(spent)} of measuring, which is"
            f" kept and not counted again; {give}"
        )
    point = choose(points, clock.plannable(), run.wanted)
    if run.wanted is not None and point.errors[run.wanted[0]].value > run.wanted[1]:
        name, goal = run.wanted
        reaching = [p for p in points if p.errors[name].value <= goal]
        if reaching:
            need = format_seconds(clock.now() + reaching[0].seconds)
            how = f"takes about {need}, which is more than --budget"
        else:
            best = min((p.errors[name] for p in points), key=lambda error: error.value)
            how = f"the best that any settings give is {error_text(name, best)}; give a larger one"
            if untried := [f"{n} {' and '.join(more)}" for n, more in run.measured.untried.items()]:
                how = f"the best of the settings that were tried is {error_text(name, best)};"
                how += f" there was no time to try {', '.join(untried)}; give a larger --budget"
        raise ConfigError(f"--error {run.state.goal}: {how}")
    return point


def _choose_rest(run: _Run, stage: Stage) -> None:
    """Begin a stage; choose its and later settings again if the time left requires it."""
    state, points = run.state, front(run.workload())
    slow = run.slowness()
    left = run.clock.left() / slow
    now = next((p for p in points if p.settings == state.settings), None)
    better = choose(points, run.clock.plannable() / slow, run.wanted)
    late = now is None or now.seconds > left
    begun = [*state.begun, stage.name]
    changed = [n for n, label in better.settings.items() if label != state.settings[n]]
    if not changed or not (late or better.worse < (now.worse if now else math.inf)):
        run.keep(begun=begun)
        return
    why = "behind" if late else "ahead of"
    moves = ", ".join(f"{n} {state.settings[n]} -> {better.settings[n]}" for n in changed)
    line = f"{why} time at {format_seconds(run.clock.now())}: {moves}"
    run.chain.tell(line)
    run.keep(settings=better.settings, begun=begun, changes=[*state.changes, line])


def _any_left(summaries: Sequence[Summary]) -> bool:
    return any(summary.count("left") for summary in summaries)


def _run_one(run: _Run, stage: Stage, before: Sequence[Summary]) -> Summary | None:
    """Run a stage until the budget ends; None if it has nothing to work on."""
    items = list(stage.items(run.chain.dataset))
    waiting: list[str] = []
    if not items:  # an earlier stage made nothing
        return None
    if _any_left(before):
        # A subject waits if an earlier stage had no time for a part of it; all wait if the stage
        # before made nothing.
        late = {o.item.split("/")[0] for s in before for o in s.outcomes if o.status == "left"}
        nothing = all(outcome.status == "left" for outcome in before[-1].outcomes)
        waiting = [item for item in items if nothing or item.split("/")[0] in late]
        items = [item for item in items if item not in waiting]
    summary = Summary(stage.name, (), 0.0)
    if items:
        if stage.name not in run.state.begun:
            _choose_rest(run, stage)
        summary = _run_ready(run, stage, items if waiting else None)
    left = tuple(Outcome(item, "left") for item in waiting)
    return replace(summary, outcomes=(*summary.outcomes, *left))


def _run_ready(run: _Run, stage: Stage, chosen: list[str] | None) -> Summary:
    chain, clock, label = run.chain, run.clock, run.state.settings[stage.name]
    load = run.workload()
    items, item = item_seconds(load, stage, label)
    factor = size_factor(load, stage, run.state.settings)
    slow, early = run.slowness(), 0.0
    item *= factor * slow
    if clock.budget:
        each, left = front(load)[0].each, clock.left()  # the quickest that may follow
        rest = sum(each[name] for name in chain.names[chain.names.index(stage.name) + 1 :])
        early = reserved(each[stage.name] * slow, rest * slow, left, clock.budget.seconds)
        if left - early < item:  # no item would begin, and a later run needs what is made now
            early = 0.0
    clock.expect(item, early)
    before = clock.now()
    config = chain.ladders[stage.name][label]
    summary = run_stage(stage, chain.dataset, config, chosen, pool=chain.pool, monitor=clock)
    made = sum(o.status == "done" and not o.restored for o in summary.outcomes)
    if made:
        run.real += clock.now() - before
        run.expected += factor * stage_seconds(load, stage, label, min(1.0, made / items))
    return summary


def reserved(own: float, rest: float, left: float, budget: float) -> float:
    """Return the seconds that a stage must leave to those after it.

    If its own seconds and the rest exceed the time left by at most a tenth of the budget, the run
    continues and ends late by at most that, rather than with nothing made. If by more, all stages
    get their shares of the time, so that some subjects go through all of them.
    """
    grace = GRACE * budget
    if 0 < own + rest - left <= grace:
        return rest - grace
    return rest * min(1.0, max(0.0, left) / max(own + rest, 1e-9))


def closing_lines(state: RunState, summaries: Sequence[Summary]) -> Iterator[str]:
    """Yield time spent, the errors that the stages state, and what is left."""
    budget = parse_budget(state.budget) if state.budget else None
    cores = budget is not None and budget.cores
    whole = f" of {state.budget}" if budget else ""
    whole += f" ({format_seconds(budget.seconds)} of core time)" if budget and cores else ""
    yield f"spent {format_seconds(state.spent)}{whole}, {format_seconds(state.seconds)} expected"
    promised = {name: said for name, said in state.promised.items() if said["stated"]}
    units = {kind.name: kind.unit for kind in RESULTS}
    units |= {name: said["unit"] for name, said in promised.items()}
    for name, (value, low, high) in state.stated.items():
        said = (
            f"{rounded(promised[name]['value'])} promised"
            if name in promised
            else "nothing promised"
        )
        yield f"{name}: {rounded(value)} {units[name]} ({rounded(low)} to {rounded(high)}), {said}"
    for name in (n for n in promised if n not in state.stated and state.finished):
        expected = f"{rounded(promised[name]['value'])} {units[name]}"
        yield f"{name}: no error is stated, {expected} promised"
    left = [f"{s.count('left')} of {s.stage}" for s in summaries if s.count("left")]
    if left:
        more = budget_text(1.1 * state.rest, cores)
        if more == state.budget:  # which would be the same run, whose time is over
            more = budget_text(1.3 * state.rest, cores)
        yield f"no time was left for the rest: {', '.join(left)}; all that is finished is kept"
        yield (
            f"to make the rest, run again with --budget {more} or more; what was spent so far does"
            " not count"
        )
    elif not state.finished:
        yield f"stopped after {summaries[-1].stage}: it leaves the next stage nothing to work on"
