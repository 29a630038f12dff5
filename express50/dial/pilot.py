"""Measure on a few items what the settings of every stage cost, and what they do to the results.

A trial is a small dataset below ``.staging/pilot``: one subject, cut to a few peaks once these are
known. The first trial runs every stage at its cheapest setting. Each other trial starts as a linked
copy of it with one stage set higher; the runner then makes only what that changes.
"""

from __future__ import annotations

import json
import os
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
from express50.errors import ConfigError, DiskFullError, Express50Error, FormatError, StageError
from express50.files.atomic import link_file, write_json
from express50.files.digests import files_of, value_digest
from express50.files.text import read_json_table
from express50.geometry.sampling import evenly
from express50.runner.executor import Pool
from express50.runner.ledger import Ledger, Receipt
from express50.runner.replaced import keeping
from express50.runner.runner import run_stage

PEAKS = 3  # expressions of a trial
STEEPER = 3.0  # a setting that was not tried may cost this many times the one below it
MEASURES = 3  # version of how results are compared
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
        return value_digest([MEASURES, steps, os.cpu_count(), self.pool.threads])[:16]

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

    def trial(self, settings: Mapping[str, str], peaks: int, source: Trial | None) -> Trial:
        """Run one trial, or read it if it ran before."""
        chain = self.chain
        name = value_digest([chain.key(), dict(settings), peaks, self.subject])[:12]
        root = chain.dataset.pilot_dir / name
        record = root / "trial.json"
        if record.is_file():
            return trial_of(json.loads(record.read_text(encoding="utf-8")))
        dataset = Dataset(root)
        if source is not None:
            shutil.rmtree(root, ignore_errors=True)
            shutil.copytree(chain.dataset.pilot_dir / source.folder, root, copy_function=_link)
            record.unlink()
        elif not root.is_dir():  # otherwise items of a trial that was stopped are kept
            self._begin(dataset)
        costs, failed = dict(source.costs) if source else {}, {}
        for stage in chain.stages:
            config = chain.ladders[stage.name][settings[stage.name]]
            try:
                cost, why = self._run(stage, dataset, config, anew=source is not None)
            except (ConfigError, DiskFullError):
                raise
            except Express50Error as error:  # an earlier stage made nothing, perhaps
                cost, why = None, str(error)
            if cost is not None:
                costs[stage.name] = cost
            if why:
                failed[stage.name] = why.replace(self.subject, "the subject")
            _cut_peaks(dataset, self.subject, peaks)
        if not dataset.subjects():
            raise StageError(": ".join(next(iter(failed.items()))))
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
            folder=name,
        )
        if not self.clock.closed():
            write_json(record, asdict(done))
        return done

    def _begin(self, dataset: Dataset) -> None:
        """Make a dataset of the subject's capture alone, and the labels that people gave."""
        given = self.chain.dataset
        dataset.root.mkdir(parents=True)
        capture = str(given.captures()[self.subject].resolve())
        write_json(dataset.captures_file, {self.subject: capture})
        labels, target = (one.labels_file(self.subject) for one in (given, dataset))
        if labels.is_file():  # the reference may be somebody whom the trial lacks
            target.parent.mkdir()
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


def cost_of(dataset: Dataset, stage: str, receipts: Sequence[Receipt], extra: float = 0.0) -> Cost:
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


def keep_for_run(dataset: Dataset, settings: Mapping[str, str]) -> None:
    """Move what trials made at chosen settings to the store of replaced outputs.

    The run takes an output from there where it would make the same. Trials that share the settings
    of more stages come first: what a stage makes depends on the stages before it as well.
    """
    moved: set[tuple[str, str]] = set()

    def alike(trial: Trial) -> int:
        differ = (k for k, name in enumerate(settings) if trial.settings[name] != settings[name])
        return next(differ, len(settings))

    trials = [
        (trial_of(json.loads(record.read_text("utf-8"))), Dataset(record.parent))
        for record in sorted(dataset.pilot_dir.glob("*/trial.json"))
    ]
    for trial, folder in sorted(trials, key=lambda pair: -alike(pair[0])):
        for subject in folder.subjects():
            with suppress(FileNotFoundError):  # the peaks before they were cut
                whole_peaks(folder, subject).rename(folder.peaks_file(subject))
        for name in (n for n, label in settings.items() if trial.settings.get(n) == label):
            with Ledger(folder.ledger, read_only=True) as ledger:
                receipts, made = ledger.read(name), ledger.made(name)
            for item in (i for i in made if (name, i) not in moved):
                keep = keeping(dataset, replace(receipts[item], made=made[item]))
                if keep is not None and folder.item_dir(name, item).is_dir():
                    keep(folder.item_dir(name, item))
                    moved.add((name, item))


def _link(source: str, target: str) -> None:
    """Link a file that is only ever replaced; copy one that is written to."""
    written = Path(source).name.startswith("ledger.sqlite") or source.endswith(".jsonl")
    (shutil.copy2 if written else link_file)(source, target)


def _rows(path: Path) -> dict[str, Any]:
    return read_json_table(path, FormatError) if path.is_file() else {}


def _cut_peaks(dataset: Dataset, subject: str, count: int) -> None:
    """Leave a few peaks, spread over the script, the first of it among them."""
    path, whole = dataset.peaks_file(subject), whole_peaks(dataset, subject)
    if not path.is_file():
        return
    if not whole.is_file():
        shutil.copy2(path, whole)
    rows = _rows(whole)
    order = [cue.expression_id for cue in read_index(dataset, subject).cues]
    names = sorted(rows, key=lambda name: order.index(name) if name in order else len(order))
    kept = evenly(names, count)
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


def tradable(chain: Chain) -> list[str]:
    """List the stages that have a choice and stand before the last measured result.

    What a later stage's settings do cannot be measured here, so it keeps its standard one.
    """
    return [name for name in chain.measurable() if len(chain.ladders[name]) > 1]


def broken_stage(chain: Chain, trial: Trial) -> str:
    """Return the first stage that made nothing, if a measured result needs it; else nothing."""
    return next((name for name in chain.measurable() if name in trial.failed), "")


def _base(pilot: Pilot, settings: dict[str, str], choices: Sequence[str]) -> Trial:
    """Run the first trial; a stage that makes nothing at its cheapest setting is set higher."""
    while True:
        base = pilot.trial(settings, PEAKS, None)
        broken = broken_stage(pilot.chain, base)
        ladder = list(pilot.chain.ladders.get(broken, ()))
        if broken not in choices or settings[broken] == ladder[-1] or pilot.clock.closed():
            return base
        settings |= {broken: ladder[ladder.index(settings[broken]) + 1]}
        pilot.chain.tell(
            f"{broken} made nothing at its cheapest setting; trying {settings[broken]}"
        )


def measure(pilot: Pilot, allowed: Callable[[PilotFigures], float]) -> PilotFigures:
    """Run trials, the cheapest first, for as many seconds as ``allowed`` gives to the first one.

    The first one, at the cheapest settings, always runs to its end or to that of the budget. Where
    a stage makes nothing whatever its settings, it stays the only one.
    """
    chain, names = pilot.chain, pilot.chain.names
    choices = tradable(chain)
    cheapest = {n: next(iter(chain.ladders[n])) if n in choices else standard_of(chain.ladders[n])
                for n in names}  # fmt: skip
    where = f"up to {PEAKS} expressions of one subject"
    chain.tell(f"measuring on {where}, every stage at its cheapest setting")
    base = _base(pilot, cheapest, choices)
    cheapest = base.settings
    began, trials = pilot.clock.now(), [base]
    untried: dict[str, list[str]] = {}
    if pilot.clock.closed() or broken_stage(chain, base):
        return PilotFigures(key=chain.key(), trials=trials, losses={})
    untold: dict[str, dict] = {name: {} for name in choices}
    allowance = allowed(PilotFigures(key=chain.key(), trials=trials, losses=untold))
    ladders = {name: list(chain.ladders[name]) for name in choices}
    higher = {n: ladder[ladder.index(cheapest[n]) + 1 :] for n, ladder in ladders.items()}
    steps = [(name, label) for name, labels in higher.items() for label in labels]
    steps.sort(key=lambda step: trial_seconds(pilot, base, step[0]))
    grown: dict[str, float] = {}
    if base.footage.expressions > 1 and trial_seconds(pilot, base, names[0]) < allowance:
        trials.append(pilot.trial(cheapest, 1, base))
    for name, label in steps:
        factor = grown.get(name, STEEPER)
        expected = trial_seconds(pilot, base, name, factor)
        if pilot.clock.now() - began + expected > allowance:
            untried.setdefault(name, []).append(label)
            continue
        chain.tell(f"measuring {name} {label}")
        trial = pilot.trial(cheapest | {name: label}, PEAKS, base)
        if pilot.clock.closed():
            untried.setdefault(name, []).append(label)
            break
        trials.append(trial)
        if name in trial.costs and name in base.costs:
            ratio = trial.costs[name].core_seconds / max(base.costs[name].core_seconds, 1e-9)
            grown[name] = STEEPER * max(1.0, ratio)
    losses = {name: _losses(pilot, trials, cheapest, name) for name in choices}
    return PilotFigures(key=chain.key(), trials=trials, losses=losses, untried=untried)


def _charged(pilot: Pilot, cost: Cost) -> float:
    """Return what a stage's items take of the budget, one after the other."""
    return cost.items * (cost.core_seconds if pilot.clock.cores else cost.seconds)


def standard_of(ladder: Ladder) -> str:
    """Return the name of the standard setting, or of the one there is."""
    return "standard" if "standard" in ladder else next(iter(ladder))


def trial_seconds(pilot: Pilot, base: Trial, name: str, factor: float = 1.0) -> float:
    """Guess the seconds of a trial that changes a stage: it, and all that follows."""
    names = pilot.chain.names
    later = [n for n in names[names.index(name) :] if n in base.costs]
    reduces = pilot.chain.stages[names.index(name)].growth.reduces  # then all later ones cost more
    return sum(
        _charged(pilot, base.costs[n]) * (factor if reduces or n == name else 1.0) for n in later
    )


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
