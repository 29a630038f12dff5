"""Run a stage over its items: skip those up to date, isolate failures, account for every item."""

from __future__ import annotations

import fnmatch
import functools
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from express50.console import count as count_of
from express50.console import format_seconds, group_lines
from express50.console import log as write
from express50.contract.config import config_toml
from express50.contract.layout import Dataset, existing_dataset
from express50.contract.stage import Note, Stage
from express50.errors import ConfigError, NotReadyError, StageError, advised, few, nearest
from express50.files.atomic import check_space, write_bytes
from express50.files.digests import file_version, path_digest
from express50.runner.executor import Pool
from express50.runner.imported import import_trouble
from express50.runner.ledger import Ledger, Made, Receipt
from express50.runner.outdated import why_outdated
from express50.runner.preflight import expected_shortage
from express50.runner.progress import RunLog, showing
from express50.runner.publish import (
    clean_leftovers,
    is_kept,
    keeping,
    make_room,
    record_published,
    run_folder,
    set_aside,
    stage_lock,
)
from express50.runner.worker import Task, failed_receipt, failure_reason, fingerprint, input_digests

REASONS = 3  # for making items again, said before they are made
OTHER_REASONS = "other reasons"
WARNINGS = 12  # lines; more of them would hide the account
ALIKE_FAILURES = 3  # if this many first items fail for the same reason, a setting is wrong
KEPT = "imported; the stage does not make it"


class RunMonitor(Protocol):
    """Sees the items and receipts of a run, and may stop further items from beginning."""

    def begun(self, item: str) -> None:
        """Take note of an item that begins."""

    def settled(self, receipt: Receipt) -> None:
        """Take note of an item that ended."""

    def closed(self) -> bool:
        """Return whether no further item may begin."""


@dataclass(frozen=True)
class Outcome:
    """The result of one item."""

    item: str
    status: str  # ``done``, ``skipped`` (was current), ``failed`` or ``left``
    reason: str = ""
    seconds: float = 0.0
    dropped: tuple[Note, ...] = ()
    warnings: tuple[Note, ...] = ()
    again: str = ""  # why it was run although a former run had made it
    restored: bool = False  # the same output had been made before, and was replaced since


@dataclass(frozen=True)
class Summary:
    """The results of all items of a stage."""

    stage: str
    outcomes: tuple[Outcome, ...]
    seconds: float

    def count(self, status: str) -> int:
        """Return the number of items with a status."""
        return sum(outcome.status == status for outcome in self.outcomes)

    @property
    def ok(self) -> bool:
        """Return whether no item failed, and none was left."""
        return self.count("failed") + self.count("left") == 0

    def to_json(self) -> dict[str, Any]:
        """Return the JSON form, which is also what a stage command prints with --json."""
        return {
            "stage": self.stage,
            "read": len(self.outcomes),
            "done": self.count("done"),
            "skipped": self.count("skipped"),
            "failed": self.count("failed"),
            "left": self.count("left"),
            "seconds": round(self.seconds, 3),
            "items": [
                asdict(outcome) | {"seconds": round(outcome.seconds, 3)}
                for outcome in self.outcomes
            ],
        }

    def lines(self) -> Iterator[str]:
        """Yield the account for people, then what was made again, dropped or failed, and why."""
        said = ("done", "skipped", "failed", *(("left",) if self.count("left") else ()))
        counts = " + ".join(f"{self.count(status)} {status}" for status in said)
        items = count_of(len(self.outcomes), "item")
        yield f"{self.stage}: {items} = {counts} in {self.seconds:.1f} s"
        made = [o for o in self.outcomes if o.status == "done"]
        again = Counter((o.restored, o.again) for o in made if o.again or o.restored)
        for (restored, why), count in again.most_common():
            yield f"  {'restored' if restored else 'made again'} {count}: {why or 'same as before'}"
        if imported := sum(o.reason == KEPT for o in self.outcomes):
            drop = f"'express50 import remove DATASET {self.stage}'"
            yield f"  kept {imported} imported (to drop them: {drop})"
        for outcome in self.outcomes:
            if outcome.status == "failed":
                yield f"  failed {outcome.item}: {outcome.reason}"
            for what, why in _joined(outcome.dropped):
                yield f"  dropped {what} of {outcome.item}: {why}"
        doubts = ((o.item, *note) for o in self.outcomes for note in _joined(o.warnings))
        doubtful = [*group_lines((f"warning {item}", f"{on}: {why}") for item, on, why in doubts)]
        for line in doubtful[:WARNINGS]:
            yield f"  {line}"
        if len(doubtful) > WARNINGS:
            yield f"  and {len(doubtful) - WARNINGS} more warnings: see the items' metrics.json"


def _joined(notes: Sequence[Note]) -> list[tuple[str, str]]:
    """Return the parts and the reason of notes, those with one reason in one line."""
    parts: dict[str, list[str]] = {}
    for note in notes:
        parts.setdefault(note.why, []).append(note.what)
    return [(", ".join(what), why) for why, what in parts.items()]


def select_items(stage: Stage, dataset: Dataset, pattern: str) -> list[str]:
    """Return the items of a stage that match a shell pattern; ConfigError if there are none."""
    known = stage.items(dataset)
    chosen = [item for item in known if fnmatch.fnmatchcase(item, pattern)]
    if not known:
        raise ConfigError(
            f"--items {pattern!r}: {stage.name} has no items yet; {_what_is_missing(dataset)}"
        )
    if not chosen:
        raise ConfigError(
            f"--items {pattern!r}: no item of {stage.name} matches{nearest(pattern, known)}; "
            f"items: {few(known, 8)}"
        )
    return chosen


def _what_is_missing(dataset: Dataset) -> str:
    existing_dataset(dataset.root)  # raises an error for folders that are none
    return f"{advised('express50 status', dataset.root)} shows which earlier stage must run first"


def run_stage(
    stage: Stage,
    dataset: Dataset,
    config: Any,
    items: Sequence[str] | None = None,
    *,
    pool: Pool,
    progress: bool = True,
    monitor: RunMonitor | None = None,
) -> Summary:
    """Bring a stage's outputs up to date; return the account of all items.

    A bad item is in the account; it does not raise. By default all items are run, and outputs of
    items that no longer exist are set aside. Workers are those of the `pool`. `progress` is shown
    on standard error. `monitor` sees every receipt, and says when no further item may begin.

    Raises:
        StageError: the stage has no items, or another run holds it.
        DiskError: the dataset's disk is nearly full, or can no longer be written to.
        NotReadyError: it has no room for the items, as far as some were measured.
    """
    started = time.perf_counter()
    dataset = Dataset(dataset.root.resolve())
    chosen = list(stage.items(dataset) if items is None else items)
    if not chosen:
        before = "name a CAPTURE" if stage.prepare else _what_is_missing(dataset)
        raise StageError(f"{dataset.root}: {stage.name} has nothing to do; {before}")
    with stage_lock(dataset, stage.name), Ledger(dataset.ledger) as ledger:
        clean_leftovers(dataset, stage.name)
        path, data = dataset.config_file(stage.name), config_toml(stage.name, config).encode()
        if not path.is_file() or path.read_bytes() != data:
            write_bytes(path, data)
        if items is None:
            gone = sorted(set(ledger.read(stage.name)) - set(chosen))
            aside = [item for item in gone if _retire(dataset, ledger, stage.name, item)]
            if aside and progress:
                words = f"{count_of(len(aside), 'item')} ({few(aside)})"
                write(f"{stage.name}: set aside {words}, which it no longer makes")
            ledger.forget(stage.name, gone)
        former = ledger.read(stage.name)
        made = sum(item in former and not former[item].reason for item in chosen)
        with RunLog(dataset.ledger, stage.name, len(chosen), made) as log:
            if shortage := expected_shortage(dataset, ledger, stage.name, chosen):
                raise NotReadyError(shortage)
            work = _sort_items(stage, dataset, config, chosen, ledger, pool.threads)
            outcomes = _run_items(stage, dataset, work, ledger, pool, progress, log, monitor)
    missing = set(chosen) - set(outcomes)
    if monitor is not None and monitor.closed():
        outcomes |= {item: Outcome(item, "left") for item in missing}
    elif missing:  # items = done + skipped + failed + left
        names = ", ".join(sorted(missing))
        raise StageError(f"{stage.name}: the outcome of {names} is unknown; run it again")
    seconds = time.perf_counter() - started
    return Summary(stage.name, tuple(outcomes[item] for item in chosen), seconds)


@dataclass(frozen=True)
class _Work:
    """The items of a stage, sorted by what has to be done."""

    former: Mapping[str, Receipt]  # receipts of former runs
    current: dict[str, Outcome]  # outcomes of items that are up to date
    unreadable: list[Receipt]  # receipts of items whose inputs cannot be read
    tasks: list[Task]  # items to run
    again: dict[str, str]  # why items are run that a former run had made
    still_valid: set[str]  # items whose former output stays valid until a new one is complete


def _sort_items(
    stage: Stage, dataset: Dataset, config: Any, chosen: list[str], ledger: Ledger, threads: int
) -> _Work:
    """Sort items into those that are up to date, unreadable, or to be run."""
    receipts, made = ledger.read(stage.name), ledger.made(stage.name)
    done = {item: receipt for item, receipt in receipts.items() if receipt.status == "done"}
    work = _Work(receipts, {}, [], [], {}, set())
    # Items share inputs; what a stage reads does not change while it runs.
    digest_of = functools.cache(lambda path: path_digest(path, ledger.sha256))
    for item in chosen:
        task = Task(stage, dataset, item, config, "", {}, threads)
        imported = receipts[item] if item in receipts and receipts[item].imported else None
        if imported is not None:
            if why := import_trouble(dataset, imported, made.get(item), digest_of):
                former = replace(task, fingerprint=imported.fingerprint)
                work.unreadable.append(failed_receipt(former, why, 0))
                continue
            if _is_there(task, made.get(item), ledger):
                work.current[item] = replace(_outcome(imported, status="skipped"), reason=KEPT)
                continue
        try:
            inputs = input_digests(stage, dataset, item, config, digest_of)
        except ConfigError:  # a setting is wrong, not an item: former outputs stay
            raise
        except Exception as error:  # noqa: BLE001 (one damaged item must not stop the others)
            reason = failure_reason(dataset, stage.name, item, error)
            work.unreadable.append(failed_receipt(task, reason, 0))
            # A StageError means that an earlier stage no longer has what the item was made from.
            if item in done and not isinstance(error, StageError):
                work.still_valid.add(item)
            continue
        task = replace(task, fingerprint=fingerprint(stage, config, inputs), inputs=inputs)
        if item in done and imported is None:
            _compare(task, done[item], made.get(item), ledger, work)
            continue
        work.tasks.append(task)
        if imported is not None:
            work.again[item] = "its import is gone"
    ledger.keep_digests()
    reasons = {receipt.reason for receipt in work.unreadable}
    made_here = not any(receipt.imported for receipt in work.unreadable)  # imports have no settings
    if len(work.unreadable) == len(chosen) > 1 and len(reasons) == 1 and made_here:
        # Former outputs then stay.
        raise StageError(f"{stage.name}: no item can be made: {reasons.pop()}")
    return work


def _compare(task: Task, former: Receipt, made: Made | None, ledger: Ledger, work: _Work) -> None:
    """Sort an item that a former run made: it is up to date, or is to be made again."""
    there, same = _is_there(task, made, ledger), former.fingerprint == task.fingerprint
    if there and same:
        current = replace(former, reason="")
        if former.reason:  # of an attempt with other settings
            ledger.note_attempt(current)
        work.current[task.item] = _outcome(current, status="skipped")
        return
    work.tasks.append(replace(task, former=replace(former, made=made)) if there else task)
    if same:
        work.again[task.item] = "output missing"
        return
    made = made or Made(task.inputs, {})
    work.again[task.item] = why_outdated(task.stage, task.item, task.config, made, task.inputs)
    if not there:
        return
    # A later stage must not read an output beside newer data of earlier stages. Files outside of
    # the dataset are different: settings name them, or they are footage, which only the first
    # stage reads.
    stage, root = task.stage, task.dataset.root
    found = stage.inputs(task.dataset, task.item, task.config)
    outside = {n for n, at in found.items() if isinstance(at, Path) and not at.is_relative_to(root)}
    names = set() if stage.prepare else {*made.inputs, *task.inputs} - outside
    if all(made.inputs.get(name) == task.inputs.get(name) for name in names):
        work.still_valid.add(task.item)


def _is_there(task: Task, made: Made | None, ledger: Ledger) -> bool:
    """Return whether an item's folder is the one that its receipt describes.

    A run may have been killed after it had published another and before the new receipt.
    """
    folder = task.dataset.item_dir(task.stage.name, task.item)
    path = folder / "metrics.json"
    if made is None or not path.is_file():
        return path.is_file()
    mark = made.files[path.name]
    if file_version(path) == (mark.size, mark.mtime_ns, mark.inode):
        return True
    files = {folder / name: mark.sha256 for name, mark in made.files.items()}  # a copy, perhaps
    return all(file.is_file() and ledger.sha256(file) == sha for file, sha in files.items())


def _run_items(
    stage: Stage,
    dataset: Dataset,
    work: _Work,
    ledger: Ledger,
    pool: Pool,
    progress: bool,
    log: RunLog,
    monitor: RunMonitor | None,
) -> dict[str, Outcome]:
    """Run the items to do and record each as it ends; return the outcomes of all items."""
    outcomes, ended = dict(work.current), []
    log.current(len(outcomes))

    def begin(task: Task) -> None:
        make_room(dataset)
        check_space(dataset.root)
        log.begin(task.item)
        if monitor is not None:
            monitor.begun(task.item)

    total = len(work.tasks) + len(work.unreadable)
    if progress:
        _say_again(stage, dataset, work)
    with showing(stage.name, total, progress) as show:

        def settle(receipt: Receipt) -> None:
            receipt = replace(receipt, time=time.time())  # workers' clocks may differ
            if receipt.status != "failed":
                record_published(dataset, ledger, receipt)
            elif receipt.item in work.still_valid:
                ledger.note_attempt(receipt)
            else:  # the former output is set aside, unread
                _retire(dataset, ledger, receipt.stage, receipt.item)
                ledger.write(receipt)
            outcomes[receipt.item] = _outcome(receipt, again=work.again.get(receipt.item, ""))
            show(receipt)
            log.settle(receipt.item)
            if monitor is not None:
                monitor.settled(receipt)

        def settle_task(receipt: Receipt) -> None:
            settle(receipt)
            ended.append(receipt)
            if len(ended) == ALIKE_FAILURES < len(work.tasks):
                _refuse_alike(stage, ended, work.former)
                # Nothing was known before of a stage that was never run.
                items = [*outcomes, *(task.item for task in work.tasks)]
                if shortage := expected_shortage(dataset, ledger, stage.name, items):
                    write(f"{stage.name}: warning: {shortage}")

        for receipt in work.unreadable:
            settle(receipt)
        if work.tasks:
            with run_folder(dataset, stage.name) as folder:
                kept: list[Task] = []  # these are only moved, so that no monitor stops them
                rest: list[Task] = []
                for task in work.tasks:
                    there = is_kept(dataset, stage.name, task.item, task.fingerprint)
                    (kept if there else rest).append(replace(task, folder=folder))
                pool.run(kept, settle_task, begin)
                pool.run(rest, settle_task, begin, monitor.closed if monitor else lambda: False)
    ledger.keep_digests()
    return outcomes


def _say_again(stage: Stage, dataset: Dataset, work: _Work) -> None:
    """Say, while it can still be stopped, which finished work a run does again, and why."""
    lost = [
        task
        for task in work.tasks
        if task.former is not None and not is_kept(dataset, stage.name, task.item, task.fingerprint)
    ]
    reasons = Counter(work.again[task.item] for task in lost).most_common(REASONS)
    spent: dict[str, list[float]] = {why: [] for why in [*dict(reasons), OTHER_REASONS]}
    for task in lost:
        why = work.again[task.item]
        spent[why if why in spent else OTHER_REASONS].append(work.former[task.item].seconds)
    for why, seconds in spent.items():
        if seconds:
            items = count_of(len(seconds), "finished item")
            took = format_seconds(sum(seconds))
            write(f"{stage.name}: makes {items} again, which took {took}: {why}")


def _refuse_alike(stage: Stage, ended: list[Receipt], former: Mapping[str, Receipt]) -> None:
    """Raise StageError if the first items fail for one reason although earlier runs made them."""
    made = all(r.item in former and not former[r.item].reason for r in ended)
    if made and all(r.status == "failed" and r.reason == ended[0].reason for r in ended):
        raise StageError(
            f"{stage.name}: the first {len(ended)} items fail with the same error, though"
            f" they worked before: {ended[0].reason}; fix the setting, or run the same command"
            " again to continue with the others"
        )


def _retire(dataset: Dataset, ledger: Ledger, stage: str, item: str) -> bool:
    """Set an output aside that no later stage may read; return whether there was one.

    It is kept in case it becomes valid again.
    """
    if not dataset.item_dir(stage, item).exists():
        return False
    former = ledger.read_whole(stage, item)
    if former is not None and former.imported:  # the store may be emptied, and no run makes it
        former = None
    set_aside(dataset, stage, item, keeping(dataset, former))
    return True


def _outcome(receipt: Receipt, status: str = "", again: str = "") -> Outcome:
    def notes(key: str) -> tuple[Note, ...]:
        return tuple(Note(row["what"], row["why"]) for row in receipt.metrics.get(key, ()))

    return Outcome(
        item=receipt.item,
        status=status or receipt.status,
        reason=receipt.reason,
        seconds=receipt.seconds,
        dropped=notes("dropped"),
        warnings=notes("warnings"),
        again=again,
        restored=receipt.status == "done" and not receipt.attempts and not status,
    )
