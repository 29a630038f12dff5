"""Audit a dataset against its ledger: report what is wrong, and set aside what can be remade.

The audit checks captures, labels, the ledger, every stage's outputs (they exist, are unchanged and
were made from the current inputs) and traces of withdrawn people.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from express50.capture.demographics import PUBLIC_KEYS
from express50.console import count
from express50.contract.config import resolve_config
from express50.contract.layout import Dataset, footage_root
from express50.contract.stage import Stage
from express50.dataset.withdraw import (
    any_id_finder,
    cameras_of,
    files_naming,
    mentions,
    subject_id_finder,
    withdrawn,
)
from express50.errors import AnnotationError, ConfigError, Express50Error, FormatError, advised, few
from express50.files.digests import file_sha256, files_of, text_digest
from express50.runner.imported import how_to_renew, import_trouble
from express50.runner.ledger import FileMark, Ledger, Receipt
from express50.runner.outdated import BAD_INPUT, differing, published_digest, why_outdated
from express50.runner.publish import (
    clean_leftovers,
    hold_stages,
    is_running,
    leftovers,
    set_aside,
    size_of,
)
from express50.runner.worker import fingerprint, input_digests
from express50.shards.reader import read_entries
from express50.shards.writer import verify

WRONG_LABELS = ("identity", "window", "unknown", "unreadable")
REPAIR = "run this check with --fix"
OUTDATED = "outdated"
LabelProblems = Callable[[Dataset, list[str]], Iterable[Any]]


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A fault: what is wrong, where, and how to fix it."""

    kind: str  # one word for programs, such as ``missing`` or ``changed``
    where: str  # ``stage item``, or a file of the dataset
    what: str  # what is wrong, in words
    fix: str  # how it was fixed, or how to fix it
    fixed: bool = False  # True if the only thing left to do is to run the stage


@dataclass
class Audit:
    """Collects findings, notes that are not faults, and counts of files, bytes and bytes hashed."""

    findings: list[Finding] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    files: int = 0
    bytes: int = 0
    hashed: int = 0

    @property
    def sound(self) -> bool:
        """Return True if every finding is fixed."""
        return all(finding.fixed for finding in self.findings)


@dataclass(frozen=True)
class Fault:
    """Says what is wrong with one item; one with files that no run wrote (`foreign`) stays put."""

    item: str
    kind: str
    what: str
    foreign: bool = False


def audit(
    dataset: Dataset,
    stages: Sequence[Stage],
    *,
    deep: bool = False,
    fix: bool = False,
    label_problems: LabelProblems = lambda dataset, subjects: (),
    checkpoints: Sequence[Path] = (),
) -> Audit:
    """Check everything that the ledger records, and set aside what can be made again.

    With `deep`, every output file is hashed, not only those whose modification time has changed.
    With `fix`, wrong outputs are set aside and their receipts forgotten; only what a stage can make
    again is deleted. `label_problems` checks the labels of subjects against their footage, and
    returns records with ``kind``, ``expression`` and ``what``. `checkpoints` are files outside the
    dataset that must not name a withdrawn person.

    Raises:
        StageError: ``fix`` is set and a stage is running.
    """
    dataset, result = Dataset(dataset.root.resolve()), Audit()
    with hold_stages(dataset, [stage.name for stage in stages]) if fix else nullcontext():
        # First, because a fix may remove the files that labels are compared with.
        result.findings += _capture_findings(dataset)
        result.findings += _label_findings(dataset, label_problems)
        # Open read-only just if the folder is: a read-only connection leaves journals behind.
        read_only = not os.access(dataset.root, os.W_OK)
        if finding := _ledger_finding(dataset, fix, read_only):
            result.findings.append(finding)
        else:
            with Ledger(dataset.ledger, read_only) as ledger:
                _StageAudit(dataset, stages, ledger, result, deep, fix).run()
        result.findings += _person_findings(dataset, checkpoints)
    what = {dataset.stale_dir: "that were set aside and are no longer used"}
    what[dataset.replaced_dir] = "that were replaced, kept in case you go back to their settings"
    for folder, words in what.items():
        files, size = size_of(folder)
        if files:
            result.notes.append(
                f"{folder.name}: {size / 1e6:.1f} MB ({files} files) of outputs {words};"
                f" {advised('express50 prune', dataset.root)} deletes them"
            )
    return result


def _capture_findings(dataset: Dataset) -> Iterator[Finding]:
    """Find missing captures, and subjects whose capture is not registered."""
    try:
        captures = dataset.captures()
    except FormatError as error:
        yield Finding(kind="capture", where="captures.json", what=str(error), fix="restore it")
        return
    ingest = advised("express50 ingest", dataset.root, "CAPTURE")
    fix = f"run {ingest} with the capture's current path"
    for subject, path in captures.items():
        try:
            what = "" if path.exists() and footage_root(path) else f"its capture {path} is missing"
        except Express50Error as error:
            what = str(error)
        if what:
            yield Finding(kind="capture", where=f"captures.json {subject}", what=what, fix=fix)
    for subject in sorted(set(dataset.subjects()) - set(captures)):
        what = "captures.json has no entry for it"
        yield Finding(kind="capture", where=f"ingest {subject}", what=what, fix=fix)


def _label_findings(dataset: Dataset, problems: LabelProblems) -> Iterator[Finding]:
    """Find labels that point at frames, cameras or expressions that do not exist."""
    known = set(dataset.subjects())
    for path in sorted((dataset.root / "labels").glob("*.jsonl")):
        where, subject = f"labels/{path.name}", path.stem
        if subject not in known:
            what, fix = f"{subject} is not ingested", "ingest the subject, or move the file away"
            yield Finding(kind="label", where=where, what=what, fix=fix)
            continue
        try:
            found = [p for p in problems(dataset, [subject]) if p.kind in WRONG_LABELS]
        except AnnotationError as error:
            yield Finding(kind="label", where=where, what=str(error), fix="restore the file")
            continue
        except Express50Error:  # the index is damaged, which is a finding of its own
            continue
        fix = (
            f"run {advised('express50 annotate ui', dataset.root)}, undo the label and mark again"
            " (the audit never changes labels, because people made them)"
        )
        for one in found:
            yield Finding(kind="label", where=f"{where} {one.expression}", what=one.what, fix=fix)


def _ledger_finding(dataset: Dataset, fix: bool, read_only: bool) -> Finding | None:
    """Find a ledger that is missing or damaged; rename it, so that stages start a new one."""
    run = advised("express50 run", dataset.root)
    again = f"run {run}, which makes every item again, with the same bytes"
    what = "is missing; without it, no output is known to come from a run"
    if dataset.ledger.is_file():
        try:
            with Ledger(dataset.ledger, read_only) as ledger:
                ledger.check_whole()
            return None
        except FormatError as error:
            what = f"is damaged ({error.__cause__ or error})"
        aside = f"ledger.sqlite.unreadable-{int(time.time())}"
        for ending in ("", "-wal", "-shm") if fix else ():
            path = dataset.root / f"ledger.sqlite{ending}"
            if path.exists():
                path.rename(dataset.root / f"{aside}{ending}")
        again = f"set aside as {aside}; {again}" if fix else f"{REPAIR}, then {again}"
    return Finding(kind="ledger", where="ledger.sqlite", what=what, fix=again, fixed=fix)


def _person_findings(dataset: Dataset, checkpoints: Sequence[Path]) -> Iterator[Finding]:
    if not (digests := withdrawn(dataset)):
        return
    there = set(dataset.subjects())
    with suppress(FormatError):  # which is a finding of its own
        there |= dataset.captures().keys()
    # Cameras of others may have a withdrawn id.
    shared = {one for one in cameras_of(dataset, there) if text_digest(one) in digests}
    finders = [any_id_finder(digests - {text_digest(one) for one in shared}, there)]
    finders += map(subject_id_finder, shared)

    def finder(text: bytes) -> bool:
        return any(one(text) for one in finders)

    found = [*files_naming(finder, dataset.root)]
    for path in [*found, *(path for path in checkpoints if mentions(path, finder))]:
        inside = path.is_relative_to(dataset.root)
        yield Finding(
            kind="person",
            where=str(path.relative_to(dataset.root) if inside else path),
            what="names a person who was withdrawn",
            fix=f"run {advised('express50 subject withdraw', dataset.root, 'ID --yes')} again (with"
            " --checkpoint if it is outside the dataset), or delete it",
        )


class _StageAudit:
    """Audits the stages once, and records which subjects turned out to be broken."""

    def __init__(
        self, dataset: Dataset, stages: Sequence[Stage], ledger: Ledger, result: Audit, deep: bool,
        fix: bool,
    ) -> None:  # fmt: skip
        self.dataset, self.stages, self.ledger = dataset, stages, ledger
        self.result, self.deep, self.fix = result, deep, fix
        captures = [f.where for f in result.findings if f.kind == "capture"]
        # Subjects of damaged items, "" for all; a missing capture has its own finding.
        self.broken = {where.removeprefix("captures.json").split(" ")[-1] for where in captures}
        self.receipts = {stage.name: ledger.read(stage.name) for stage in stages}
        self.made = {stage.name: ledger.made(stage.name) for stage in stages}
        sha256 = file_sha256 if deep else ledger.sha256
        self.digest = published_digest(dataset, self.made, sha256)

    def run(self) -> None:
        """Audit each stage; a fault in one stage is not reported again for later stages."""
        for stage in self.stages:
            if not self.fix and is_running(self.dataset, stage.name):
                self._note(stage, "is running; its items were not checked")
                self.broken.add("")
                continue
            if found := leftovers(self.dataset, stage.name):
                if self.fix:
                    clean_leftovers(self.dataset, stage.name)
                what = f"unfinished outputs of {count(len(found), 'interrupted run')}"
                how = "deleted" if self.fix else "--fix deletes them, as the next run would"
                self._find("leftover", f".staging {stage.name}", what, how, self.fix)
            self._stage(stage)
        if self.fix:
            self.ledger.keep_digests()

    def _stage(self, stage: Stage) -> None:
        try:
            known = set(stage.items(self.dataset))
        except BAD_INPUT:  # the list of items is damaged
            known = None
        receipts = self.receipts[stage.name]
        faults = list(self._output_faults(stage.name))
        if stage.name == "ingest":
            faults += self._personal_faults(receipts.keys() - {fault.item for fault in faults})
        wrong = {fault.item for fault in faults}
        for fault in faults:
            self._settle(stage.name, fault, known is None or fault.item in known)
        sound = {k: r for k, r in receipts.items() if k not in wrong and r.status == "done"}
        if sound:
            self._judge(stage, sound)
        failed = {item for item, receipt in receipts.items() if receipt.status == "failed"}
        to_do = (known or set()) - receipts.keys() - wrong
        # None of these has an output now; what was made from an earlier one is valid again once
        # the same output is back.
        self.broken |= {item.split("/")[0] for item in wrong | failed | to_do}
        if to_do and receipts:
            words = f"{len(to_do)} of {count(len(known or ()), 'item')} to do"
            run = advised(f"express50 {stage.name}", self.dataset.root)
            self._note(stage, f"{words}; run {run}")
        if failures := sum(bool(receipt.reason) for receipt in receipts.values()):
            self._note(stage, f"{count(failures, 'item')} failed; see status")

    def _output_faults(self, stage: str) -> Iterator[Fault]:
        """Find outputs that are missing, changed or unaccounted for, at most one fault per item."""
        top = self.dataset.stage_dir(stage)
        there = {p.parent.relative_to(top).as_posix() for p in top.glob("*/metrics.json")}
        nested = (p.parent.relative_to(top) for p in top.glob("*/*/metrics.json"))
        there |= {path.as_posix() for path in nested if path.parts[0] not in there}
        done = {i for i, r in self.receipts[stage].items() if r.status == "done"}
        made = self.made[stage]
        for item in sorted(done):
            if item not in there:
                yield Fault(item, "missing", "the ledger has a receipt, but the output is missing")
            elif item in made and (fault := self._changed(stage, item, made[item].files)):
                yield fault
        for item in sorted(there - (done & made.keys())):
            what = "has no receipt: its run did not finish, or no run made it"
            yield Fault(item, "unknown", what)

    def _changed(self, stage: str, item: str, marks: Mapping[str, FileMark]) -> Fault | None:
        folder = self.dataset.item_dir(stage, item)
        there = {path.relative_to(folder).as_posix(): path for path in files_of(folder)}
        gone, foreign = sorted(marks.keys() - there.keys()), sorted(there.keys() - marks.keys())
        other = []
        for name in sorted(marks.keys() & there.keys()):
            mark, stat = marks[name], there[name].stat()
            self.result.files += 1
            self.result.bytes += stat.st_size
            same = stat.st_size == mark.size
            if same and (self.deep or stat.st_mtime_ns != mark.mtime_ns):  # as copying does
                self.result.hashed += stat.st_size
                same = file_sha256(there[name]) == mark.sha256
            if not same:
                other.append(name)
        states = {"missing": gone, "not as published": other, "not written by a run": foreign}
        words = [f"{few(names)} {state}" for state, names in states.items() if names]
        if words:
            kind = "missing" if gone else "changed" if other else "foreign"
            return Fault(item, kind, ", ".join(words), bool(foreign))
        if not {"index.json", "manifest.json"} <= there.keys():
            return None
        try:  # the shards' own checksums: all of them, or only whether index and sizes fit
            read_entries(folder)
            faults = verify(folder) if self.deep else []
        except FormatError as error:
            faults = [str(error)]
        return Fault(item, "shards", few(faults)) if faults else None

    def _personal_faults(self, subjects: set[str]) -> Iterator[Fault]:
        """Find indices that hold keys of capture.toml that must stay out of the dataset."""
        for subject in sorted(subjects):
            try:
                table = json.loads(self.dataset.index_file(subject).read_text(encoding="utf-8"))
                keys = sorted(set(table["meta"]) - PUBLIC_KEYS)
            except (OSError, ValueError, KeyError, TypeError):  # damaged: found elsewhere
                continue
            if keys:
                what = f"index.json holds personal data from capture.toml: {', '.join(keys)}"
                yield Fault(subject, "personal", what)

    def _settle(self, stage: str, fault: Fault, known: bool) -> None:
        """Set a faulty item aside where its stage can make it again."""
        again, fixed = self._again(stage), False
        receipt = self.receipts[stage].get(fault.item)
        if receipt is not None and receipt.imported:  # no run can make it again
            how = how_to_renew(self.dataset, stage)
        elif fault.foreign:
            how = "move files that no run wrote out of the folder, then check again"
        elif not known and fault.kind == "unknown":
            how = f"{stage} no longer has such an item; delete it if you do not need it"
        elif fault.kind == OUTDATED:  # a run finds this by itself
            fixed, how = self.fix, again
        elif self.fix:
            fixed, how = True, f"set aside; to make it again, {again}"
            set_aside(self.dataset, stage, fault.item)
            self.ledger.forget(stage, [fault.item])
        else:
            how = (
                f"{REPAIR}, then {again}" if known else f"{REPAIR}; the stage has no such item now"
            )
        self._find(fault.kind, f"{stage} {fault.item}", fault.what, how, fixed)

    def _judge(self, stage: Stage, receipts: dict[str, Receipt]) -> None:
        """Report items that were made from different inputs, settings or code versions."""
        path, name = self.dataset.config_file(stage.name), stage.name
        try:
            config = resolve_config(stage, "standard", path, (), [s.name for s in self.stages])
        except ConfigError as error:
            how = f"run {advised(f'express50 {name}', self.dataset.root)} with valid settings"
            self._find("config", f"config/{path.name}", str(error), how)
            return
        unreadable: dict[str, list[str]] = {}
        to_make: dict[str, list[str]] = {}
        for item, receipt in receipts.items():
            if receipt.imported:
                made = self.made[name].get(item)
                if why := import_trouble(self.dataset, receipt, made, self.digest):
                    self._find(OUTDATED, f"{name} {item}", why, how_to_renew(self.dataset, name))
                continue
            try:
                now = input_digests(stage, self.dataset, item, config, self.digest)
            except BAD_INPUT as error:
                unreadable.setdefault(f"{type(error).__name__}: {error}", []).append(item)
                continue
            if fingerprint(stage, config, now) == receipt.fingerprint:
                continue
            made = self.made[name][item]
            changed = differing(made.inputs, now)
            if not changed:
                why = why_outdated(stage, item, config, made, now)
                to_make.setdefault(why, []).append(item)
            elif self._waits(item):
                self._note(stage, f"{item} cannot be checked until its inputs are made again")
            else:
                what = f"these inputs changed since it was made: {few(changed)}"
                self._settle(name, Fault(item, OUTDATED, what), True)
        for reason, items in unreadable.items():
            if not all(self._waits(item) for item in items):
                what = f"its inputs cannot be read: {reason}"
                self._find("unreadable", f"{name} {few(items, 1)}", what, self._again(name))
        for why, items in to_make.items():
            self._note(stage, f"outdated {few(items, 1)}: {why}; the next run makes them again")

    def _again(self, stage: str) -> str:
        again = advised(f"express50 {stage}", self.dataset.root)
        return f"run {again} with the same settings as before"

    def _waits(self, item: str) -> bool:
        subject = item.split("/")[0]
        known = subject in self.receipts[self.stages[0].name]
        return bool(self.broken & {"", subject}) or (bool(self.broken) and not known)

    def _note(self, stage: Stage, words: str) -> None:
        self.result.notes.append(f"{stage.name}: {words}")

    def _find(self, kind: str, where: str, what: str, how: str, fixed: bool = False) -> None:
        finding = Finding(kind=kind, where=where, what=what, fix=how, fixed=fixed)
        self.result.findings.append(finding)
