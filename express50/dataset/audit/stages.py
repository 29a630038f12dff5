"""Audit the outputs of stages: present, as published, and made from the present inputs."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from express50.capture.demographics import PUBLIC_KEYS
from express50.contract.config import resolve_config
from express50.contract.layout import Dataset
from express50.contract.stage import Stage
from express50.dataset.audit.finding import Audit, Finding
from express50.errors import ConfigError, Express50Error, FormatError
from express50.files.digests import file_sha256, files_of, path_digest, text_digest
from express50.runner.ledger import FileMark, Ledger, Made, Receipt, mark_file
from express50.runner.publish import clean_leftovers, is_running, set_aside
from express50.runner.worker import fingerprint, input_digests
from express50.shards.reader import read_entries
from express50.shards.writer import verify

# Damaged inputs may fail in any of these ways before a stage has checked them.
BAD_INPUT = (Express50Error, OSError, ValueError, KeyError, TypeError)


@dataclass(frozen=True)
class Fault:
    """Says what is wrong with one item; files of nobody (`foreign`) must not be moved."""

    item: str
    kind: str
    what: str
    foreign: bool = False


@dataclass
class Judgement:
    """Items of a stage by how they were made; `fresh` has the inputs of those that are right.

    Attributes:
        outdated: item to the names of inputs that have other content now.
        settings: items made with other settings or by another version.
        unsaid: items that differ in one of these; the ledger is too old to say which.
        unreadable: reason to the items whose inputs cannot be read.
        fresh: item to the digests of its inputs.
    """

    outdated: dict[str, list[str]] = field(default_factory=dict)
    settings: list[str] = field(default_factory=list)
    unsaid: list[str] = field(default_factory=list)
    unreadable: dict[str, list[str]] = field(default_factory=dict)
    fresh: dict[str, dict[str, str]] = field(default_factory=dict)


class StageAudit:
    """Passes over the stages once; state: which subjects were found broken on the way."""

    def __init__(
        self,
        dataset: Dataset,
        stages: Sequence[Stage],
        ledger: Ledger,
        result: Audit,
        deep: bool,
        fix: bool,
    ) -> None:
        self.dataset, self.stages, self.ledger = dataset, stages, ledger
        self.result, self.deep, self.fix = result, deep, fix
        captures = [f.where for f in result.findings if f.kind == "capture"]
        # Subjects of damaged items, "" is all; a capture that is gone has its own finding.
        self.broken = {where.removeprefix("captures.json").split(" ")[-1] for where in captures}
        self.receipts = {stage.name: ledger.read(stage.name) for stage in stages}
        self.made = {stage.name: ledger.made(stage.name) for stage in stages}
        sha256 = file_sha256 if deep else ledger.sha256
        self.digest = published_digest(dataset, self.made, sha256)

    def run(self) -> None:
        """Audit each stage; what an earlier one lacks is not held against a later one."""
        for stage in self.stages:
            if not self.fix and is_running(self.dataset, stage.name):
                self._note(stage, "runs now; its items were not looked at")
                self.broken.add("")
                continue
            if found := list(self.dataset.staging_dir.glob(f"{stage.name}-*")):
                if self.fix:
                    clean_leftovers(self.dataset, stage.name)
                what = f"{len(found)} unfinished outputs of a run that was killed"
                how = "deleted" if self.fix else "--fix deletes them, as the next run would"
                self._find("leftover", f".staging {stage.name}", what, how, self.fix)
            self._stage(stage)
        if self.fix:
            self.ledger.keep_digests()

    def _stage(self, stage: Stage) -> None:
        try:
            known = set(stage.items(self.dataset))
        except BAD_INPUT:  # what names the items is damaged
            known = None
        receipts = self.receipts[stage.name]
        faults = list(self._output_faults(stage.name))
        wrong = {fault.item for fault in faults}
        if stage.name == "ingest":
            faults += self._personal_faults(receipts.keys() - wrong)
            wrong = {fault.item for fault in faults}
        for fault in faults:
            self._settle(stage.name, fault, known is None or fault.item in known)
        sound = {k: r for k, r in receipts.items() if k not in wrong and r.status == "done"}
        if sound:
            self._judge(stage, sound)
        failed = {item for item, receipt in receipts.items() if receipt.status == "failed"}
        to_do = (known or set()) - receipts.keys() - wrong
        # None of these has an output: what was made of a former one is right once it is back.
        self.broken |= {item.split("/")[0] for item in wrong | failed | to_do}
        if to_do and receipts:
            count = f"{len(to_do)} of {len(known or ())} items are to do"
            self._note(stage, f"{count}; run 'express50 {stage.name}'")
        if failed:
            self._note(stage, f"{len(failed)} items failed; see status")

    def _output_faults(self, stage: str) -> Iterator[Fault]:
        """Find outputs that are missing, changed or unaccounted for, at most one fault per item."""
        top = self.dataset.stage_dir(stage)
        there = {p.parent.relative_to(top).as_posix() for p in top.glob("*/metrics.json")}
        nested = (p.parent.relative_to(top) for p in top.glob("*/*/metrics.json"))
        there |= {path.as_posix() for path in nested if path.parts[0] not in there}
        done = [item for item, r in self.receipts[stage].items() if r.status == "done"]
        for item in done:
            if item not in there:
                yield Fault(item, "missing", "the ledger has a receipt, its output is gone")
            elif fault := self._changed(stage, item):
                yield fault
        for item in sorted(there - set(done)):
            what = "an output without a receipt: its run did not end, or no run made it"
            yield Fault(item, "unknown", what)

    def _changed(self, stage: str, item: str) -> Fault | None:
        folder = self.dataset.item_dir(stage, item)
        if item in self.made[stage]:
            marks = self.made[stage][item].files
            there = {path.relative_to(folder).as_posix(): path for path in files_of(folder)}
            gone = sorted(marks.keys() - there.keys())
            other = [name for name in sorted(marks.keys() & there.keys())
                     if self._differs(there[name], marks[name])]  # fmt: skip
            foreign = sorted(there.keys() - marks.keys())
            words = [
                f"{_few(names)} {state}"
                for names, state in (
                    (gone, "gone"),
                    (other, "not as published"),
                    (foreign, "written by no run"),
                )
                if names
            ]
            if words:
                kind = "missing" if gone else "changed" if other else "foreign"
                return Fault(item, kind, ", ".join(words), bool(foreign))
        if not (folder / "index.json").is_file() or not (folder / "manifest.json").is_file():
            return None
        try:  # the shards' own checksums: all of them, or only whether index and sizes fit
            read_entries(folder)
            faults = verify(folder) if self.deep else []
        except FormatError as error:
            faults = [str(error)]
        return Fault(item, "shards", _few(faults)) if faults else None

    def _differs(self, path: Path, mark: FileMark) -> bool:
        """Compare a file's bytes; a copy has another time, so time alone is not evidence."""
        stat = path.stat()
        self.result.files += 1
        self.result.bytes += stat.st_size
        if stat.st_size != mark.size:
            return True
        if not self.deep and stat.st_mtime_ns == mark.mtime_ns:
            return False
        self.result.hashed += stat.st_size
        return file_sha256(path) != mark.sha256

    def _personal_faults(self, subjects: set[str]) -> Iterator[Fault]:
        """Find indices that hold keys of capture.toml which must stay outside the dataset."""
        for subject in sorted(subjects):
            try:
                table = json.loads(self.dataset.index_file(subject).read_text(encoding="utf-8"))
                keys = sorted(set(table["meta"]) - PUBLIC_KEYS)
            except (OSError, ValueError, KeyError, TypeError):  # damaged: found elsewhere
                continue
            if keys:
                what = f"index.json holds {', '.join(keys)} of capture.toml, which stay outside"
                yield Fault(subject, "personal", what)

    def _settle(self, stage: str, fault: Fault, known: bool) -> None:
        """Set a faulty item aside where its stage can make it again."""
        again, fixed = f"express50 {stage} {self.dataset.root}", False
        if fault.foreign:
            how = "move what no run wrote out of the folder, then check again"
        elif not known and fault.kind == "unknown":
            how = f"{stage} has no such item now; move it away if nobody needs it"
        elif self.fix:
            fixed, how = True, f"set aside; make it again: {again}"
            set_aside(self.dataset, stage, fault.item)
            self.ledger.forget(stage, [fault.item])
        else:
            how = f"--fix, then {again}" if known else "--fix; the stage has no such item now"
        self._find(fault.kind, f"{stage} {fault.item}", fault.what, how, fixed)

    def _judge(self, stage: Stage, receipts: dict[str, Receipt]) -> None:
        """Report items that were made from or with something else."""
        path, name = self.dataset.config_file(stage.name), stage.name
        again = f"express50 {name} {self.dataset.root}"
        try:
            config = resolve_config(stage, "standard", path, (), [s.name for s in self.stages])
        except ConfigError as error:
            how = f"{again}, with the settings that you want"
            self._find("config", f"config/{path.name}", str(error), how)
            return
        found = judge(stage, self.dataset, config, receipts, self.made[name], self.digest)
        for item, names in found.outdated.items():
            if self._waits(item):
                self.result.notes.append(
                    f"{name} {item}: cannot be judged before what it reads is made again"
                )
            else:
                what = f"made from another {_few(names)} than is there now"
                self._settle(name, Fault(item, "outdated", what), True)
        for reason, items in found.unreadable.items():
            if not all(self._waits(item) for item in items):
                what = f"its inputs cannot be read: {reason}"
                self._find("unreadable", f"{name} {_few(items, 1)}", what, again)
        if found.settings:
            words = "items were made with other settings or by another version"
            self._note(stage, f"{len(found.settings)} {words}; the next run makes them again")
        if found.unsaid:
            words = "items made by an older toolkit: inputs, settings or version differ"
            self._note(stage, f"{len(found.unsaid)} {words}; the next run makes them again")
        self._adopt(stage, {k: v for k, v in found.fresh.items() if k not in self.made[name]})

    def _adopt(self, stage: Stage, bare: dict[str, dict[str, str]]) -> None:
        """Take digests of outputs that were made before digests were kept."""
        if bare:
            how = "they count as they are now" if self.fix else "--fix takes digests now"
            words = "items of an older toolkit have no digests; only their presence was checked"
            self._note(stage, f"{len(bare)} {words} ({how})")
        for item, inputs in bare.items() if self.fix else ():
            folder = self.dataset.item_dir(stage.name, item)
            files = {p.relative_to(folder).as_posix(): mark_file(p) for p in files_of(folder)}
            receipt = self.receipts[stage.name][item]
            self.ledger.write(replace(receipt, made=Made(inputs, files)))
            self.ledger.know(folder, files)

    def _waits(self, item: str) -> bool:
        """True if something that the item may read is broken."""
        subject = item.split("/")[0]
        known = subject in self.receipts[self.stages[0].name]
        return bool(self.broken & {"", subject}) or (bool(self.broken) and not known)

    def _note(self, stage: Stage, words: str) -> None:
        self.result.notes.append(f"{stage.name}: {words}")

    def _find(self, kind: str, where: str, what: str, how: str, fixed: bool = False) -> None:
        finding = Finding(kind=kind, where=where, what=what, fix=how, fixed=fixed)
        self.result.findings.append(finding)


def published_digest(
    dataset: Dataset, made: Mapping[str, Mapping[str, Made]], sha256: Callable[[Path], str]
) -> Callable[[Path], str]:
    """Return a function that digests paths as `path_digest` does, with files as published.

    A damaged file is made again to the same bytes, and does not make wrong what was made of the
    good one. Files that no stage published count as they are.
    """
    files: dict[Path, str] = {}
    below: dict[Path, list[Path]] = {}
    folders: set[Path] = set()
    for stage, items in made.items():
        for item, row in items.items():
            folder = dataset.item_dir(stage, item)
            folders.add(folder)
            for name, mark in row.files.items():
                path = folder / name
                files[path] = mark.sha256
                for parent in path.parents[: len(path.relative_to(dataset.root).parts) - 1]:
                    below.setdefault(parent, []).append(path)
    known = dict(files)

    def digest(path: Path) -> str:
        if path not in known and path not in below:
            known[path] = path_digest(path, sha256)
        elif path not in known:
            table = {file: files[file] for file in below[path]}
            for file in files_of(path) if path.is_dir() else ():
                if folders.isdisjoint(file.parents):  # made before digests were kept
                    table[file] = sha256(file)
            rows = (f"{file.relative_to(path).as_posix()} {table[file]}" for file in sorted(table))
            known[path] = text_digest("\n".join(rows))
        return known[path]

    return digest


def judge(
    stage: Stage,
    dataset: Dataset,
    config: object,
    receipts: Mapping[str, Receipt],
    made: Mapping[str, Made],
    digest: Callable[[Path], str],
) -> Judgement:
    """Compare receipts of a stage with the present inputs, settings and version."""
    found = Judgement()
    for item, receipt in receipts.items():
        try:
            now = input_digests(stage, dataset, item, config, digest)
        except BAD_INPUT as error:
            found.unreadable.setdefault(f"{type(error).__name__}: {error}", []).append(item)
            continue
        if fingerprint(stage, config, now) == receipt.fingerprint:
            found.fresh[item] = now
        elif item not in made:
            found.unsaid.append(item)
        else:
            before = made[item].inputs
            changed = [k for k in sorted(before.keys() | now.keys()) if before.get(k) != now.get(k)]
            if changed:
                found.outdated[item] = changed
            else:
                found.settings.append(item)
    return found


def _few(names: Sequence[str], count: int = 3) -> str:
    """List the first names, then how many more there are."""
    more = f" and {len(names) - count} more" if len(names) > count else ""
    return ", ".join(names[:count]) + more
