"""Measure on a few items what the settings of every stage cost, and what they do to the results.

A trial is a small dataset below ``.staging/pilot``: one subject, cut to a few peaks once these are
known if it has many. The first trial runs every stage at its cheapest setting. Each other trial
starts as a linked copy of it with one stage set higher; the runner then makes only what that
changes.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import mean, median
from typing import Any

from express50.capture.index import read_index
from express50.contract.layout import Dataset
from express50.contract.stage import Stage, typical_error
from express50.dial.budget import Clock
from express50.dial.figures import Cost, PilotFigures, Trial, footage_of, trial_of
from express50.dial.results import RESULTS, ResultKind, differences, whole_peaks
from express50.errors import ConfigError, DiskError, Express50Error, FormatError, StageError
from express50.files.atomic import link_file, write_json
from express50.files.digests import files_of, value_digest
from express50.files.text import read_json_table
from express50.geometry.sampling import evenly
from express50.runner.executor import Pool
from express50.runner.ledger import Ledger, Receipt
from express50.runner.publish import keeping
from express50.runner.runner import run_stage

TRIAL_EXPRESSIONS = 3  # expressions of a trial
WHOLE_SUBJECT = 6  # expressions, up to which all are tried: a run then reuses all of a trial
LIKELY_RATIO = 2.0  # assumed cost of an untried setting over that of the setting below it
WORST_RATIO = 3.0  # the same at worst; 1.5 to 2.7 were measured
COMPARISON_VERSION = 3  # version of how results are compared
Ladder = Mapping[str, Any]  # configurations of a stage by the name of the setting, cheapest first


@dataclass
class Chain:
    """The stages of a dataset with their settings, and the workers that run them."""

    stages: Sequence[Stage]  # in order
    dataset: Dataset
    ladders: Mapping[str, Ladder]  # settings of each stage
    pool: Pool
    tell: Callable[[str], None]  # takes lines for people
    kinds: Sequence[ResultKind] = RESULTS  # results that are measured

    @property
    def names(self) -> list[str]:
        """Return the names of the stages."""
        return [stage.name for stage in self.stages]

    def key(self) -> str:
        """Return a digest of everything that measured figures depend on but the footage."""
        steps = {
            stage.name: [stage.version, {k: vars(c) for k, c in self.ladders[stage.name].items()}]
            for stage in self.stages
        }
        return value_digest([COMPARISON_VERSION, steps, os.cpu_count(), self.pool.threads])[:16]

    def measurable(self) -> list[str]:
        """Return the names of the stages up to the last one that makes a measured result."""
        names = self.names
        makers = [name for kind in self.kinds for name in kind.made_by(names)]
        return names[: max(map(names.index, makers), default=-1) + 1]


@dataclass
class Pilot:
    """Runs trials of a chain on one subject's footage; the clock counts and stops them."""

    chain: Chain
    subject: str
    clock: Clock
    cut: bool = False  # whether the time ended in the last trial, so that it measured nothing

    def record(self, settings: Mapping[str, str], peaks: int) -> Path:
        """Return the path of what a trial measured, in the trial's folder."""
        name = value_digest([self.chain.key(), dict(settings), peaks, self.subject])[:12]
        return self.chain.dataset.pilot_dir / name / "trial.json"

    def trial(
        self,
        settings: Mapping[str, str],
        peaks: int,
        source: Trial | None,
        words: str = "",
        limit: float = math.inf,
    ) -> Trial:
        """Run one trial, or read it if it ran before.

        `settings` are named by stage; `source` is the trial to start from. `words` tell people what
        is measured before it runs. After `limit` seconds none of its items begins.
        """
        chain, record = self.chain, self.record(settings, peaks)
        self.cut = False
        if record.is_file():
            return trial_of(json.loads(record.read_text(encoding="utf-8")))
        if words:
            chain.tell(words)
        root, until = record.parent, self.clock.now() + limit
        dataset = Dataset(root)
        if source is not None:
            shutil.rmtree(root, ignore_errors=True)
            # A copy that is stopped must not pass for a trial that ran.
            left_out, place = shutil.ignore_patterns(record.name), chain.dataset.pilot_dir
            shutil.copytree(place / source.folder, root, ignore=left_out, copy_function=_link)
        self._begin(dataset)  # what a trial that was stopped has made is kept
        costs, failed = dict(source.costs) if source else {}, {}
        for stage in chain.stages:
            config = chain.ladders[stage.name][settings[stage.name]]
            before = source.costs.get(stage.name) if source else None
            self.clock.expect(0.0 if before is None else _item_seconds(self, before), until=until)
            try:
                cost, why = self._run(stage, dataset, config, anew=source is not None)
            except (ConfigError, DiskError):
                raise
            except Express50Error as error:  # an earlier stage made nothing, perhaps
                cost, why = None, str(error)
            if cost is not None:
                costs[stage.name] = cost
            if why:
                own = rf"(?<![\w.]){re.escape(self.subject)}(?!\w)"  # not in words and numbers
                failed[stage.name] = re.sub(own, "the subject", why)
            _cut_peaks(dataset, self.subject, peaks)
            broken = stage.name in failed and stage.name in chain.measurable()
            if self.cut or broken:  # what follows would be of older outputs, or of none
                break
        if not dataset.subjects():
            raise StageError(": ".join(next(iter(failed.items()), ("", "the time is over"))))
        count = len(_rows(dataset.peaks_file(self.subject)))
        whole = footage_of(dataset)
        footage = replace(whole, expressions=float(max(1, count)))
        done = Trial(
            settings=dict(settings),
            footage=footage,
            scripted=whole.expressions,
            costs=costs,
            errors=stated_errors(chain, dataset),
            failed=failed,
            folder=root.name,
        )
        if not self.cut:
            write_json(record, asdict(done))
        return done

    def _begin(self, dataset: Dataset) -> None:
        """Make a dataset of the subject's capture alone, and the labels that people gave."""
        given = self.chain.dataset
        capture = str(given.captures()[self.subject].resolve())
        write_json(dataset.captures_file, {self.subject: capture})
        labels, target = (one.labels_file(self.subject) for one in (given, dataset))
        # The reference may be somebody whom the trial lacks.
        if labels.is_file() and not target.is_file():
            target.parent.mkdir(exist_ok=True)
            shutil.copy2(labels, target)

    def _run(
        self, stage: Stage, dataset: Dataset, config: Any, anew: bool
    ) -> tuple[Cost | None, str]:
        """Run a stage; returns what an item cost, if any was made, and why all failed.

        Only items that are made in this run count, if ``anew``: others are of another trial.
        """
        if not stage.items(dataset):
            return None, "an earlier stage made nothing for it"
        pool = self.chain.pool
        summary = run_stage(
            stage, dataset, config, pool=pool, progress=not anew, monitor=self.clock
        )
        self.cut = summary.count("left") > 0
        counted = ("done",) if anew else ("done", "skipped")
        made = {o.item for o in summary.outcomes if o.status in counted}
        failures = [o.reason for o in summary.outcomes if o.status == "failed"]
        with Ledger(dataset.ledger, read_only=True) as ledger:
            receipts = [r for i, r in ledger.read(stage.name).items() if i in made]
        why = failures[0] if len(failures) == len(summary.outcomes) else ""
        if not receipts:
            return None, why
        width = min(pool.width(), len(receipts))
        extra = max(0.0, summary.seconds - sum(r.seconds for r in receipts) / width)
        return cost_of(dataset, stage.name, receipts, extra), why


def cost_of(dataset: Dataset, stage: str, receipts: Sequence[Receipt], extra: float) -> Cost:
    """Sum up what items cost; a first item that loads libraries counts little in the median."""
    typical = median if len(receipts) > 2 else mean
    folders = [dataset.item_dir(stage, receipt.item) for receipt in receipts]
    return Cost(
        seconds=typical(r.seconds for r in receipts),
        core_seconds=typical(r.core_seconds or r.seconds for r in receipts),
        bytes=mean(sum(p.stat().st_size for p in files_of(folder)) for folder in folders),
        memory=max(r.peak_memory for r in receipts),
        items=len(receipts),
        extra=extra,
    )


def keep_for_run(dataset: Dataset, settings: Mapping[str, str], trials: Sequence[Trial]) -> None:
    """Put copies of what trials made at chosen settings into the store of replaced outputs.

    The run takes an output from there where it would make the same. Trials that share the settings
    of more stages come first: what a stage makes depends on the stages before it as well.
    """
    kept: set[tuple[str, str]] = set()

    def alike(trial: Trial) -> int:
        differ = (k for k, name in enumerate(settings) if trial.settings[name] != settings[name])
        return next(differ, len(settings))

    there = [t for t in trials if t.folder and (dataset.pilot_dir / t.folder).is_dir()]
    for trial in sorted(there, key=lambda trial: -alike(trial)):
        folder = Dataset(dataset.pilot_dir / trial.folder)
        for name in (n for n, label in settings.items() if trial.settings[n] == label):
            with Ledger(folder.ledger, read_only=True) as ledger:
                receipts, made = ledger.read(name), ledger.made(name)
            for item in (i for i in made if (name, i) not in kept):
                keep = keeping(dataset, replace(receipts[item], made=made[item]))
                if keep is not None and folder.item_dir(name, item).is_dir():
                    keep(_copied(folder, name, item))
                    kept.add((name, item))


def _copied(trial: Dataset, stage: str, item: str) -> Path:
    """Copy an output of a trial by links, with the peaks as they were before they were cut."""
    copy = trial.root.parent / "copy"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(trial.item_dir(stage, item), copy, copy_function=_link)
    with suppress(FileNotFoundError):
        whole = whole_peaks(trial, item).name
        (copy / whole).replace(copy / trial.peaks_file(item).name)
    return copy


def _link(source: str, target: str) -> None:
    """Link a file that is only ever replaced; copy one that is written to."""
    written = Path(source).name.startswith("ledger.sqlite") or source.endswith(".jsonl")
    (shutil.copy2 if written else link_file)(source, target)


def _rows(path: Path) -> dict[str, Any]:
    return read_json_table(path, FormatError) if path.is_file() else {}


def _cut_peaks(dataset: Dataset, subject: str, count: int) -> None:
    """Leave a few peaks, spread over the script, the first of it among them; all if few."""
    path, whole = dataset.peaks_file(subject), whole_peaks(dataset, subject)
    if not path.is_file():
        return
    if not whole.is_file():
        shutil.copy2(path, whole)
    rows = _rows(whole)
    order = [cue.expression_id for cue in read_index(dataset, subject).cues]
    names = sorted(rows, key=lambda name: order.index(name) if name in order else len(order))
    kept = names if 1 < count < len(names) <= WHOLE_SUBJECT else evenly(names, count)
    if set(kept) != _rows(path).keys():
        write_json(path, {name: rows[name] for name in rows if name in kept})


def stated_errors(chain: Chain, dataset: Dataset) -> dict[str, list[float]]:
    """Return what stages state about the error of each result: value, low and high."""
    found = {}
    with Ledger(dataset.ledger, read_only=True) as ledger:
        for kind in chain.kinds:
            for name in kind.made_by(chain.names):
                error = typical_error(r.metrics for r in ledger.read(name).values())
                if error is not None and error.unit == kind.unit and kind.name not in found:
                    found[kind.name] = [error.value, error.low, error.high]
    return found


def broken_stage(chain: Chain, trial: Trial) -> str:
    """Return the first stage that made nothing, if a measured result needs it; else nothing."""
    return next((name for name in chain.measurable() if name in trial.failed), "")


def _base(pilot: Pilot, settings: dict[str, str], choices: Sequence[str]) -> Trial:
    """Run the first trial; a stage that makes nothing at its cheapest setting is set higher."""
    where = "on a few expressions of one subject"
    words = f"measuring {where}, every stage at its cheapest setting"
    while True:
        base = pilot.trial(settings, TRIAL_EXPRESSIONS, None, words)
        broken = broken_stage(pilot.chain, base)
        ladder = list(pilot.chain.ladders.get(broken, ()))
        if broken not in choices or settings[broken] == ladder[-1] or pilot.cut:
            return base
        settings |= {broken: ladder[ladder.index(settings[broken]) + 1]}
        words = f"{broken} made nothing at its cheapest setting; trying {settings[broken]}"


def measure(
    pilot: Pilot, spare: Callable[..., float], doubtful: Callable[[PilotFigures], float]
) -> PilotFigures:
    """Run trials, the cheapest first, while there is time for them and for a run with the result.

    `spare` returns the seconds that a run with the best choice so far would leave, also with the
    setting of a guessed trial; `doubtful` those by which a trial of one expression may correct the
    plan.

    The first trial, at the cheapest settings, runs until it or the budget ends. It is the only one
    if a stage makes nothing at any setting.
    """
    chain, names = pilot.chain, pilot.chain.names
    # Later stages keep their standard settings, because nothing measures what those do.
    choices = [name for name in chain.measurable() if len(chain.ladders[name]) > 1]
    cheapest = {n: next(iter(chain.ladders[n])) if n in choices else standard_of(chain.ladders[n])
                for n in names}  # fmt: skip
    base = _base(pilot, cheapest, choices)
    found = PilotFigures(key=chain.key(), trials=[base], losses={})
    if pilot.cut or broken_stage(chain, base):
        return found
    found = replace(
        found, losses={name: _losses(pilot, [base], base.settings, name) for name in choices}
    )
    limit = min(spare(found), doubtful(found))
    if base.footage.expressions > 1 and (
        pilot.record(base.settings, 1).is_file() or one_peak_seconds(pilot, base) <= limit
    ):
        single = pilot.trial(base.settings, 1, base, "measuring one expression alone", limit)
        if not pilot.cut:
            found = replace(found, trials=[base, single])
    grown: dict[str, float] = {}  # how many times as long as at first a stage took, at most
    for name, label in _steps(pilot, base, choices):
        settings, factor = {**base.settings, name: label}, grown.get(name, 1.0)
        pilot.clock.expect(0.0)
        known, limit = pilot.record(settings, TRIAL_EXPRESSIONS).is_file(), spare(found)
        likely, worst = (
            guessed(pilot, base, name, label, factor * f) for f in (LIKELY_RATIO, WORST_RATIO)
        )
        # Even at its worst, the trial must leave time for the best choice so far.
        fits = trial_seconds(pilot, worst, name) <= limit and (
            trial_seconds(pilot, likely, name) <= spare(found, likely)
        )
        if known or fits:
            trial = pilot.trial(
                settings, TRIAL_EXPRESSIONS, base, f"measuring {name} {label}", limit
            )
            if not pilot.cut:
                trials = [*found.trials, trial]
                losses = found.losses | {name: _losses(pilot, trials, base.settings, name)}
                found = replace(found, trials=trials, losses=losses)
                if name in trial.costs and name in base.costs:
                    before = max(base.costs[name].core_seconds, 1e-9)
                    grown[name] = max(1.0, trial.costs[name].core_seconds / before)
                continue
        untried = [*found.untried.get(name, []), label]
        found = replace(found, untried=found.untried | {name: untried})
    pilot.clock.expect(0.0)
    pilot.cut = False  # the first trial is whole
    return found


def _steps(pilot: Pilot, base: Trial, choices: Sequence[str]) -> list[tuple[str, str]]:
    """List settings above the cheapest ones: first one step up, as a second one gains less.

    Those whose trials are quicker come first. Larger pictures than were recorded change nothing.
    """
    steps, growth = [], {stage.name: stage.growth for stage in pilot.chain.stages}
    for name in choices:
        configs, seen = pilot.chain.ladders[name], base.footage
        higher = list(configs)[list(configs).index(base.settings[name]) + 1 :]
        if growth[name].reduces:
            size = {one: seen.after(growth[name], configs[one]).picture for one in higher}
            higher = [one for one in higher if size[one] > seen.picture]
        seconds = trial_seconds(pilot, base, name)
        steps += [(rank, seconds, (name, label)) for rank, label in enumerate(higher)]
    return [step for _, _, step in sorted(steps)]


def standard_of(ladder: Ladder) -> str:
    """Return the name of the standard setting, or of the one there is."""
    return "standard" if "standard" in ladder else next(iter(ladder))


def _item_seconds(pilot: Pilot, cost: Cost) -> float:
    return cost.core_seconds if pilot.clock.cores else cost.seconds


def _charged(pilot: Pilot, cost: Cost) -> float:
    """Return the seconds of the budget that a stage's items take."""
    width = 1 if pilot.clock.cores else min(pilot.chain.pool.width(), cost.items)
    return cost.items * _item_seconds(pilot, cost) / width


def guessed(pilot: Pilot, base: Trial, name: str, label: str, factor: float) -> Trial:
    """Guess the figures of a trial with a higher setting of a stage, `factor` times as slow.

    Later stages take as long as before, but longer where the setting makes their pictures larger.
    """
    stages = pilot.chain.stages[pilot.chain.names.index(name) :]
    config, costs = pilot.chain.ladders[name][label], dict(base.costs)
    footage = base.footage.after(stages[0].growth, config)
    for stage in (one for one in stages if one.name in costs):
        more = footage.time(stage.growth) / base.footage.time(stage.growth)
        more, cost = factor if stage.name == name else more, costs[stage.name]
        costs[stage.name] = replace(
            cost, seconds=cost.seconds * more, core_seconds=cost.core_seconds * more
        )
    return replace(base, settings={**base.settings, name: label}, costs=costs)


def trial_seconds(pilot: Pilot, guess: Trial, name: str) -> float:
    """Return the seconds of a trial that changes a stage: it, and all that follows."""
    names = pilot.chain.names
    later = [n for n in names[names.index(name) :] if n in guess.costs]
    return sum(_charged(pilot, guess.costs[n]) for n in later)


def one_peak_seconds(pilot: Pilot, base: Trial) -> float:
    """Guess the seconds of a trial of one expression, which reuses what depends on no other."""
    seconds, changed = 0.0, False
    for stage in pilot.chain.stages:
        changed |= "expressions" in stage.growth.time
        if changed and stage.name in base.costs:
            cost = base.costs[stage.name]
            each = "expressions" in stage.growth.items
            seconds += _charged(pilot, cost) / (cost.items if each else 1)
    return seconds


def _losses(
    pilot: Pilot, trials: Sequence[Trial], cheapest: Mapping[str, str], name: str
) -> dict[str, dict[str, float]]:
    """Compare the results at each tried setting of a stage with those at the most expensive one."""
    full = [t for t in trials if t.footage.expressions == trials[0].footage.expressions]
    tried = {
        label: next((t for t in full if t.settings == {**cheapest, name: label}), None)
        for label in pilot.chain.ladders[name]
    }
    good = {label: t for label, t in tried.items() if t is not None and name not in t.failed}
    if not good:
        return {}
    root = pilot.chain.dataset.pilot_dir
    others = {label: Dataset(root / trial.folder) for label, trial in good.items()}
    best = list(others.values())[-1]
    return {
        label: differences(other, best, pilot.subject, pilot.chain.kinds) if other != best else {}
        for label, other in others.items()
    }
