"""Run the whole chain within a budget: measure, choose, say what to expect, keep to it.

``dial/run.json`` holds what was chosen and what was spent. A run that was stopped continues with
the same choices within the same budget; one that was finished, with the whole budget again. Before
each stage the remaining settings are chosen again with the speed seen so far; a stage that has
begun keeps its setting.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from express50.console import count, format_seconds
from express50.contract.config import made_with
from express50.contract.layout import Dataset, exclusion_reason
from express50.contract.stage import Stage
from express50.dial.budget import Budget, Clock, Goal, budget_text
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
    taken_over,
)
from express50.dial.figures import PilotFigures, dial_dir, footage_of, read_measured
from express50.dial.pilot import (
    Chain,
    Pilot,
    broken_stage,
    keep_for_run,
    measure,
    stated_errors,
)
from express50.dial.results import RESULTS
from express50.errors import ConfigError, FormatError, StageError
from express50.files.atomic import write_json
from express50.files.text import read_json_table
from express50.runner.ledger import Ledger
from express50.runner.runner import Summary, run_stage

SPARE_SHARE = 0.5  # of the time that the cheapest settings would leave over, for trials
SAFETY = 0.95  # of the time left is planned with: what items take varies
BELIEVED = 0.1  # of the expected time must have passed before its speed changes choices
GRACE = 0.1  # of the budget by which a run may end late rather than stop with nothing made
BUSY = 1.5  # times its processor time on all workers: waiting took much of a trial
PILOTS = 3  # subjects whose footage is tried if the first one's is bad


@dataclass(frozen=True, kw_only=True)
class RunState:
    """A budgeted run, as stored."""

    key: str  # `Chain.key` of what was measured
    budget: str  # as it was written; empty with a goal alone
    goal: str  # as it was written, or empty
    spent: float = 0.0  # seconds, of the clock or of all cores
    settings: dict[str, str] = field(default_factory=dict)  # name of the setting of each stage
    # stages that have begun, which keep their setting
    begun: list[str] = field(default_factory=list)
    # expected error of each result, as said before the start
    promised: dict[str, dict[str, Any]] = field(default_factory=dict)
    seconds: float = 0.0  # expected before the start
    changes: list[str] = field(default_factory=list)  # what was chosen again later, and why
    # ``[value, low, high]`` of each result, as the stages state in the end
    stated: dict[str, list[float]] = field(default_factory=dict)
    finished: bool = False  # whether nothing was left


def run_file(dataset: Dataset) -> Path:
    """Return the path of the state of a dataset's budgeted run."""
    return dial_dir(dataset) / "run.json"


def measured_figures(chain: Chain, clock: Clock, chosen: bool = False) -> PilotFigures:
    """Read what was measured of a chain's dataset, or measure it.

    Settings that there was no time to try are tried by the next run, unless its settings are
    ``chosen`` already. Trials that are still there are not run again.

    Raises:
        ConfigError: the budget ended before any footage was ingested.
        StageError: no footage can be measured.
    """
    path = dial_dir(chain.dataset) / "measured.json"
    found = read_measured(path, chain.key())
    if found is not None and (chosen or not found.untried):
        return found
    found = _measure_one(chain, clock)
    if not clock.closed():
        write_json(path, asdict(found))
    return found


def _measure_one(chain: Chain, clock: Clock) -> PilotFigures:
    """Measure the first subject whose footage every stage can work on; raises what callers do."""
    root = chain.dataset.root
    captures = chain.dataset.captures()
    subjects = [s for s in captures if not exclusion_reason(chain.dataset, s)]
    if captures and not subjects:
        take_in = f"express50 annotate include {root} {min(captures)}"
        raise StageError(f"{root}: every subject is excluded; to take one in again: '{take_in}'")
    if not subjects:
        raise StageError(f"{root}: has no captures yet; run 'express50 run {root} CAPTURE'")

    def allowed(base: PilotFigures) -> float:
        need = front(workload(chain, base, clock.cores, {}))[0].seconds
        return SPARE_SHARE * (clock.left() - need)

    for subject in subjects[:PILOTS]:
        try:
            found = measure(Pilot(chain, subject, clock), allowed)
            broken = broken_stage(chain, found.trials[0])
            if not broken or clock.closed():  # a stage without time has no output
                return found
            reason = f"{broken}: {found.trials[0].failed[broken]}"
        except StageError as error:  # nothing is ingested
            reason = str(error)
            if clock.budget is not None and clock.closed():
                raise ConfigError(
                    f"--budget {clock.budget.text}: the time ended before the footage of {subject}"
                    " was ingested; give more time"
                ) from error
        chain.tell(f"{subject} cannot be measured: {reason}")
    raise StageError(
        f"{root}: no subject could be measured: {reason}; correct that, or run without --budget to"
        " see what each stage says"
    )


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
                    made = sum(r.status == "done" for r in ledger.read(stage.name).values())
                    share = min(1.0, made / item_seconds(load, stage, label)[0])
                    made_here[stage.name] = label, share
    there = [t for t in measured.trials if t.folder and (dataset.pilot_dir / t.folder).is_dir()]
    return replace(load, done=[made_here, *(taken_over(load, trial) for trial in there)])


@dataclass
class _Run:
    """A run as it goes on.

    Attributes:
        chain, clock: as given.
        state: as stored.
        measured: of the pilot.
        wanted: name of the result that has a goal, and the goal.
        real, expected: seconds that stages took so far, and that were expected of them.
    """

    chain: Chain
    clock: Clock
    state: RunState
    measured: PilotFigures = field(init=False)
    wanted: tuple[str, float] | None = None
    real: float = 0.0
    expected: float = 0.0

    def keep(self, **changes: Any) -> None:
        """Change the state, and store it with what is spent."""
        self.state = replace(self.state, **changes)
        write_json(
            run_file(self.chain.dataset), asdict(replace(self.state, spent=self.clock.now()))
        )

    def asked(self) -> str:
        """Write the budget and the goal with the result that it is for."""
        goal = f"error {self.state.goal} of the {self.wanted[0]}" if self.wanted else ""
        return ", ".join(filter(None, [self.state.budget and f"budget {self.state.budget}", goal]))

    def workload(self) -> Workload:
        """Describe what is left to make; stages that have begun keep their setting."""
        begun = {name: self.state.settings[name] for name in self.state.begun}
        return workload(self.chain, self.measured, self.clock.cores, begun)

    def slowness(self) -> float:
        """Return how much longer stages took than expected; 1 while too little was seen."""
        believed = max(1.0, BELIEVED * (self.state.seconds - self.state.spent))
        if self.expected < believed:
            return 1.0
        return min(4.0, max(0.5, self.real / self.expected))


def run_within(
    chain: Chain, budget: Budget | None, goal: Goal | None, ended: Callable[[Stage, Summary], None]
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
    if goal is not None:
        check_unit(chain.kinds, goal)
    state = _resumed(chain, budget, goal)
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
        path = run_file(chain.dataset)
        if path.is_file() and not read_json_table(path, FormatError).get("settings"):
            path.unlink()
        raise


def _measure_and_run(
    run: _Run, goal: Goal | None, again: bool, ended: Callable[[Stage, Summary], None]
) -> tuple[list[Summary], RunState]:
    """Measure, choose settings unless they are chosen already, and run the stages."""
    chain, clock, state = run.chain, run.clock, run.state
    run.measured = measured_figures(chain, clock, chosen=bool(state.settings))
    load = run.workload()
    run.wanted = None if goal is None else (goal_result(load, goal), goal.value)
    if not state.settings:
        point = _first_choice(run, load, goal)
        promised = {name: asdict(error) for name, error in point.errors.items()}
        run.state = replace(
            state, settings=point.settings, seconds=clock.now() + point.seconds, promised=promised
        )
        keep_for_run(chain.dataset, point.settings)
        lines = choice_lines(load, point, run.asked(), clock.now())
    else:
        if again:
            run.state = replace(state, seconds=clock.now() + front(load)[0].seconds)
        spent = "with the whole budget again" if again else f"{format_seconds(clock.now())} spent"
        lines = iter([f"continuing with the chosen settings, {spent}"])
    for line in lines:
        chain.tell(line)
    run.keep()
    summaries = []
    for stage in chain.stages:
        if stage.name not in run.state.begun:
            _choose_rest(run, stage)
        summary = _run_one(run, stage)
        if summary is None:
            break
        summaries.append(summary)
        ended(stage, summary)
    whole = len(summaries) == len(chain.stages) and not any(s.count("left") for s in summaries)
    stated = stated_errors(chain, chain.dataset) if summaries else {}
    run.state = replace(run.state, spent=clock.now())
    run.keep(finished=whole, stated=stated)
    if whole:
        shutil.rmtree(chain.dataset.pilot_dir, ignore_errors=True)
    return summaries, run.state


def _resumed(chain: Chain, budget: Budget | None, goal: Goal | None) -> RunState:
    """Read the run to continue, or begin a new one if budget or goal differ."""
    fresh = RunState(
        key=chain.key(), budget=budget.text if budget else "", goal=goal.text if goal else ""
    )
    path = run_file(chain.dataset)
    if not path.is_file():
        return fresh
    try:
        state = RunState(**read_json_table(path, FormatError, "delete it to choose again"))
    except TypeError as error:
        raise FormatError(f"{path}: not a run ({error}); delete it to choose again") from error
    same = (state.key, state.budget, state.goal) == (fresh.key, fresh.budget, fresh.goal)
    return state if same else fresh


def _first_choice(run: _Run, load: Workload, goal: Goal | None) -> Point:
    clock, wanted, points = run.clock, run.wanted, front(load)
    left = clock.left()
    if clock.closed() or points[0].seconds > left:
        spent, least = clock.now(), points[0].seconds
        words = "core time" if load.cores else f"with {count(load.width, 'worker')}"
        asked = f"--budget {clock.budget.text if clock.budget else ''}"
        if clock.closed():
            raise ConfigError(
                f"{asked}: it ended before every stage was measured at its cheapest setting; the"
                f" cheapest settings need more than {format_seconds(spent + least)} {words}; give"
                " several times as much; what was measured is kept"
            )
        more = 1.1 * least
        give = f"give --budget {budget_text(more, load.cores)} or more"
        if clock.budget is not None and more <= clock.budget.seconds:
            give = "the same command again will do"
        core = point_of(replace(load, cores=True), points[0].settings).seconds
        if not load.cores and least > BUSY * core / load.width:
            give += f"; only {format_seconds(core)} of it is processor time: where other programs"
            give += f" slowed the measuring, give --budget {budget_text(1.1 * core, True)} instead"
        raise ConfigError(
            f"{asked}: the cheapest settings need about {format_seconds(least)} {words} after"
            f" {format_seconds(spent)} of measuring, which is kept and not counted again; {give}"
        )
    point = choose(points, left * SAFETY, wanted)
    if goal is not None and wanted is not None and point.errors[wanted[0]].value > goal.value:
        name = wanted[0]
        reaching = [p for p in points if p.errors[name].value <= goal.value]
        if reaching:
            need = format_seconds(clock.now() + reaching[0].seconds)
            how = f"takes about {need}, which is more than --budget"
        else:
            best = min((p.errors[name] for p in points), key=lambda error: error.value)
            how = f"the best that any settings give is {error_text(name, best)}"
            if untried := [f"{n} {' and '.join(more)}" for n, more in run.measured.untried.items()]:
                how = f"the best of the settings that were tried is {error_text(name, best)};"
                how += f" there was no time to try {', '.join(untried)}; give a larger --budget"
        raise ConfigError(f"--error {goal.text}: {how}")
    return point


def _choose_rest(run: _Run, stage: Stage) -> None:
    """Begin a stage; choose its and later settings again if the time left requires it."""
    state, points = run.state, front(run.workload())
    left = run.clock.left() / run.slowness()
    now = next((p for p in points if p.settings == state.settings), None)
    better = choose(points, left * SAFETY, run.wanted)
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


def _run_one(run: _Run, stage: Stage) -> Summary | None:
    """Run a stage until the budget ends; None if it has nothing to work on."""
    chain, clock, label = run.chain, run.clock, run.state.settings[stage.name]
    load = run.workload()
    items, item = item_seconds(load, stage, label)
    factor = size_factor(load, stage, run.state.settings)
    slow, early = run.slowness(), 0.0
    if clock.budget:
        each = front(load)[0].each  # the quickest that may follow
        rest = sum(each[name] for name in chain.names[chain.names.index(stage.name) + 1 :])
        early = reserved(each[stage.name] * slow, rest * slow, clock.left(), clock.budget.seconds)
    clock.expect(factor * item * slow, early)
    before = clock.now()
    if not stage.items(chain.dataset):  # an earlier stage made nothing
        return None
    config = chain.ladders[stage.name][label]
    summary = run_stage(stage, chain.dataset, config, pool=chain.pool, monitor=clock)
    made = sum(o.status == "done" and not o.restored for o in summary.outcomes)
    if made:
        run.real += clock.now() - before
        run.expected += factor * stage_seconds(load, stage, label, min(1.0, made / items))
    return summary


def reserved(own: float, rest: float, left: float, budget: float) -> float:
    """Return the seconds that a stage must leave to those after it.

    Where its own seconds and the rest are over the time left by a tenth of the budget at most, the
    run goes on and ends late rather than with nothing made.
    """
    short = own + rest - left
    return rest - short if 0 < short <= GRACE * budget else rest


def closing_lines(state: RunState, summaries: Sequence[Summary]) -> Iterator[str]:
    """Yield time spent, the errors that the stages state, and what is left."""
    whole = f" of {state.budget}" if state.budget else ""
    yield f"spent {format_seconds(state.spent)}{whole}, {format_seconds(state.seconds)} expected"
    promised = {name: said for name, said in state.promised.items() if said["stated"]}
    units = {kind.name: kind.unit for kind in RESULTS}
    units |= {name: said["unit"] for name, said in promised.items()}
    for name, (value, low, high) in state.stated.items():
        said = f"{promised[name]['value']:.2g} promised" if name in promised else "nothing promised"
        yield f"{name}: {value:.2g} {units[name]} ({low:.2g} to {high:.2g}), {said}"
    for name in (n for n in promised if n not in state.stated and state.finished):
        yield f"{name}: no error is stated, {promised[name]['value']:.2g} {units[name]} promised"
    left = [f"{s.count('left')} of {s.stage}" for s in summaries if s.count("left")]
    if not state.finished:
        what = ", ".join(left) or "later stages"
        yield f"the time is over; left: {what}; a larger --budget continues from here"
