"""The audit of a whole dataset, and its mending."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from express50.contract.layout import Dataset
from express50.contract.stage import Stage
from express50.dataset.audit.finding import Finding
from express50.dataset.audit.inputs import Judgement, Published, items_of, judge
from express50.dataset.audit.ledger import ledger_fault, open_ledger, set_ledger_aside
from express50.dataset.audit.outputs import Fault, Looked, StageState, output_faults
from express50.dataset.audit.sources import (
    capture_findings,
    label_findings,
    leftovers,
    personal_keys,
    saved_config,
)
from express50.dataset.id_search import files_that, names_any_of, says
from express50.dataset.withdraw import withdrawn
from express50.errors import FormatError
from express50.files.digests import file_sha256, files_of
from express50.runner.ledger import Ledger
from express50.runner.locks import hold_stages, is_running
from express50.runner.publish import clean_leftovers, set_aside
from express50.runner.receipts import Made, mark_file

STALE_WORDS = "outputs set aside earlier, which nothing reads; making an item again removes its own"


@dataclass
class Audit:
    """What an audit found and did.

    Attributes:
        findings: what is wrong.
        notes: what is worth knowing and no fault.
        looked: how much was looked at.
    """

    findings: list[Finding] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    looked: Looked = field(default_factory=Looked)

    @property
    def sound(self) -> bool:
        """Whether nothing wrong is left."""
        return all(finding.mended for finding in self.findings)


def audit(
    dataset: Dataset,
    stages: Sequence[Stage],
    *,
    deep: bool = False,
    mend: bool = False,
    label_problems: Callable[[Dataset, list[str]], Iterable[Any]] = lambda dataset, subjects: (),
    checkpoints: Sequence[Path] = (),
) -> Audit:
    """Look at everything that the ledger knows, and mend what can be made again.

    Args:
        dataset: the dataset.
        stages: its stages in order.
        deep: read every output's bytes; else only of files whose time of change is another.
        mend: set wrong outputs aside and forget their receipts; nothing is deleted that no stage
            can make again.
        label_problems: checks the labels of subjects against their footage.
        checkpoints: files outside the dataset in which no withdrawn person may be named.

    Raises:
        StageError: a stage runs that was to be mended.
    """
    dataset = Dataset(dataset.root.resolve())
    result = Audit()
    names = [stage.name for stage in stages]
    with hold_stages(dataset, names) if mend else nullcontext():
        # First, as mending takes away what labels are compared with.
        result.findings += _tables(dataset, label_problems)
        if why := ledger_fault(dataset):
            result.findings.append(_broken_ledger(dataset, why, mend))
        else:
            with open_ledger(dataset) as ledger:
                _Run(dataset, stages, ledger, result, deep, mend).stages_in_order()
        result.findings += _people(dataset, checkpoints)
    stale = [path for path in dataset.stale_dir.rglob("*") if path.is_file()]
    if stale:
        size = sum(path.stat().st_size for path in stale) / 1e6
        result.notes.append(f".stale: {len(stale)} files, {size:.1f} MB, of {STALE_WORDS}")
    return result


def _broken_ledger(dataset: Dataset, why: str, mend: bool) -> Finding:
    again = f"express50 run {dataset.root}: every item is made again, to the same bytes"
    if dataset.ledger.exists() and not mend:
        again = f"--mend, then {again}"
    if mend:
        again = f"set aside as {set_ledger_aside(dataset).name}; {again}"
    return Finding(kind="ledger", what="ledger.sqlite", why=why, mend=again, mended=mend)


def _tables(dataset: Dataset, label_problems: Callable[..., Iterable[Any]]) -> Iterator[Finding]:
    try:
        yield from capture_findings(dataset)
    except FormatError as error:
        why, _, mend = str(error).removeprefix(f"{dataset.captures_file}: ").partition("; ")
        yield Finding(kind="capture", what="captures.json", why=why, mend=mend)
        return
    yield from label_findings(dataset, label_problems)


def _people(dataset: Dataset, checkpoints: Sequence[Path]) -> Iterator[Finding]:
    if not (digests := withdrawn(dataset)):
        return
    test = names_any_of(digests)
    found = [*files_that(test, dataset.root), *(path for path in checkpoints if says(path, test))]
    for path in found:
        yield Finding(
            kind="person",
            what=str(path.relative_to(dataset.root) if path.is_relative_to(dataset.root) else path),
            why="names a person who was withdrawn",
            mend=f"express50 subject withdraw {dataset.root} ID --yes again (--checkpoint for one "
            "outside the dataset), or delete it",
        )


class _Run:
    """One pass over the stages; state: what was found broken on the way."""

    def __init__(
        self,
        dataset: Dataset,
        stages: Sequence[Stage],
        ledger: Ledger,
        result: Audit,
        deep: bool,
        mend: bool,
    ) -> None:
        self.dataset, self.stages, self.ledger = dataset, stages, ledger
        self.result, self.deep, self.mend = result, deep, mend
        # Subjects of damaged items, "" is all; a capture that is gone has its own finding.
        self.broken = {f.what.removeprefix("captures.json").split(" ")[-1]
                       for f in result.findings if f.kind == "capture"}  # fmt: skip
        self.states = {s.name: StageState(receipts=ledger.read(s.name), made=ledger.made(s.name))
                       for s in stages}  # fmt: skip
        sha256 = file_sha256 if deep else ledger.sha256
        self.published = Published(dataset, self.states, sha256)

    def stages_in_order(self) -> None:
        """Audit each stage; what an earlier one lacks is not held against a later one."""
        for stage in self.stages:
            if not self.mend and is_running(self.dataset, stage.name):
                self.result.notes.append(f"{stage.name}: runs now; its items were not looked at")
                self.broken.add("")
            else:
                self._leftovers(stage.name)
                self._stage(stage)
        if self.mend:
            self.ledger.keep_digests()

    def _leftovers(self, stage: str) -> None:
        if found := leftovers(self.dataset, stage):
            if self.mend:
                clean_leftovers(self.dataset, stage)
            self.result.findings.append(
                Finding(
                    kind="leftover",
                    what=f".staging {stage}",
                    why=f"{len(found)} unfinished outputs of a run that was killed",
                    mend="deleted" if self.mend else "--mend deletes them, as the next run would",
                    mended=self.mend,
                )
            )

    def _stage(self, stage: Stage) -> None:
        state = self.states[stage.name]
        known = items_of(stage, self.dataset)
        faults = list(output_faults(self.dataset, stage.name, state, self.deep, self.result.looked))
        faults += self._personal(stage.name, {fault.item for fault in faults})
        self._settle(stage.name, faults, known)
        wrong = {fault.item for fault in faults}
        sound = {item: r for item, r in state.receipts.items() if item not in wrong}
        config = saved_config(self.dataset, stage, [s.name for s in self.stages]) if sound else None
        if isinstance(config, Finding):
            self.result.findings.append(config)
        elif config is not None:
            state = replace(state, receipts=sound)
            self._judged(stage.name, judge(stage, self.dataset, config, state, self.published))
        receipts = self.states[stage.name].receipts
        failed = {item for item, receipt in receipts.items() if receipt.status == "failed"}
        to_do = set(known or ()) - set(receipts) - wrong
        # None of these has an output: what was made of a former one is right once it is back.
        self.broken |= {_subject(item) for item in wrong | failed | to_do}
        if to_do and receipts:
            count = f"{len(to_do)} of {len(known or ())} items are to do"
            self.result.notes.append(f"{stage.name}: {count}; run 'express50 {stage.name}'")
        if failed:
            self.result.notes.append(f"{stage.name}: {len(failed)} items failed; see status")

    def _personal(self, stage: str, wrong: set[str]) -> Iterator[Fault]:
        if stage != "ingest":
            return
        for subject in self.states[stage].receipts:
            if subject not in wrong and (keys := personal_keys(self.dataset, subject)):
                why = f"index.json holds {', '.join(keys)} of capture.toml, which stay outside"
                yield Fault(subject, "personal", why)

    def _settle(self, stage: str, faults: list[Fault], known: list[str] | None) -> None:
        """Findings of faulty items, mended where their stage can make them again."""
        for fault in faults:
            again = f"express50 {stage} {self.dataset.root}"
            if fault.foreign:
                mended, how = False, "move what no run wrote out of the folder, then check again"
            elif known is None or fault.item in known:
                mended, how = self.mend, "--mend, then " + again
            elif fault.kind == "unknown":
                mended, how = False, f"no item of {stage} today; move it away if nobody needs it"
            else:
                mended, how = self.mend, "--mend; the stage has no such item now"
            if mended:
                self._set_aside(stage, fault.item)
                how = f"set aside; make it again: {again}"
            self._find(fault.kind, f"{stage} {fault.item}", fault.why, how, mended)

    def _judged(self, stage: str, judgement: Judgement) -> None:
        """Findings and notes of items that were made from or with something else."""
        again = f"express50 {stage} {self.dataset.root}"
        for item, names in judgement.outdated.items():
            if self._waits(item):
                words = "cannot be judged before what it reads is made again"
                self.result.notes.append(f"{stage} {item}: {words}")
                continue
            why = f"made from another {', '.join(names[:3])}" + ", ..." * (len(names) > 3)
            how = "--mend, then " + again
            if self.mend:
                self._set_aside(stage, item)
                how = f"set aside; make it again: {again}"
            self._find("outdated", f"{stage} {item}", why + " than is there now", how, self.mend)
        for reason, items in judgement.unreadable.items():
            if not all(self._waits(item) for item in items):
                what = f"{stage} {items[0]}" + f" and {len(items) - 1} more" * (len(items) > 1)
                self._find("unreadable", what, f"its inputs cannot be read: {reason}", again, False)
        self._old(stage, judgement)

    def _old(self, stage: str, judgement: Judgement) -> None:
        if count := len(judgement.settings):
            words = "made with other settings or by another version; the next run makes them again"
            self.result.notes.append(f"{stage}: {count} items were {words}")
        if count := len(judgement.unsaid):
            words = "inputs, settings or version differ; the next run makes them again"
            self.result.notes.append(f"{stage}: of {count} items made by an older toolkit {words}")
        bare = {k: v for k, v in judgement.fresh.items() if k not in self.states[stage].made}
        if bare and self.mend:
            for item, inputs in bare.items():
                self._adopt(stage, item, inputs)
            words = "without digests: their bytes as they are now count from now on"
            self.result.notes.append(f"{stage}: {len(bare)} items of an older toolkit {words}")
        elif bare:
            words = "have no digests; only their presence was checked (--mend takes digests now)"
            self.result.notes.append(f"{stage}: {len(bare)} items of an older toolkit {words}")

    def _adopt(self, stage: str, item: str, inputs: dict[str, str]) -> None:
        folder = self.dataset.item_dir(stage, item)
        files = {p.relative_to(folder).as_posix(): mark_file(p) for p in files_of(folder)}
        receipt = self.states[stage].receipts[item]
        self.ledger.write(replace(receipt, made=Made(inputs, files)))
        self.ledger.know(folder, files)

    def _waits(self, item: str) -> bool:
        """Whether something that the item may read is broken."""
        subject = _subject(item)
        known = subject in self.states[self.stages[0].name].receipts
        return bool(self.broken & {"", subject}) or (bool(self.broken) and not known)

    def _set_aside(self, stage: str, item: str) -> None:
        set_aside(self.dataset, stage, item)
        self.ledger.forget(stage, [item])

    def _find(self, kind: str, what: str, why: str, mend: str, mended: bool) -> None:
        self.result.findings.append(
            Finding(kind=kind, what=what, why=why, mend=mend, mended=mended)
        )


def _subject(item: str) -> str:
    return item.split("/")[0]
