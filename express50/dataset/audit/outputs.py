"""The outputs of one stage against what the ledger says was published."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from express50.contract.layout import Dataset
from express50.errors import FormatError
from express50.files.digests import file_sha256, files_of
from express50.runner.receipts import FileMark, Made, Receipt
from express50.shards.reader import read_entries
from express50.shards.writer import verify


@dataclass
class Looked:
    """How much was looked at."""

    files: int = 0
    bytes: int = 0
    hashed: int = 0


@dataclass(frozen=True)
class Fault:
    """What is wrong with one item; ``foreign`` files are nobody's output and must not be moved."""

    item: str
    kind: str
    why: str
    foreign: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class StageState:
    """What the ledger says of a stage."""

    receipts: Mapping[str, Receipt]
    made: Mapping[str, Made] = field(default_factory=dict)


def published_items(dataset: Dataset, stage: str) -> list[str]:
    """Items whose folder is there, sorted; a folder is one by its metrics.json."""
    top = dataset.stage_dir(stage)
    found = {path.parent.relative_to(top).as_posix() for path in top.glob("*/metrics.json")}
    nested = (path.parent for path in top.glob("*/*/metrics.json"))
    found |= {p.relative_to(top).as_posix() for p in nested if p.parent.name not in found}
    return sorted(found)


def output_faults(
    dataset: Dataset, stage: str, state: StageState, deep: bool, looked: Looked
) -> Iterator[Fault]:
    """Faults of a stage's outputs, at most one an item.

    Args:
        dataset: the dataset.
        stage: its name.
        state: receipts, and what was published.
        deep: read every file; else only those whose time of change is another.
        looked: counts what was looked at.
    """
    there = published_items(dataset, stage)
    for item, receipt in state.receipts.items():
        if receipt.status != "done":
            continue
        if item not in there:
            yield Fault(item, "missing", "the ledger has a receipt, its output is gone")
        elif fault := _changed(dataset.item_dir(stage, item), item, state, deep, looked):
            yield fault
    done = {item for item, receipt in state.receipts.items() if receipt.status == "done"}
    for item in (one for one in there if one not in done):
        yield Fault(item, "unknown", "an output without a receipt: its run did not end, or no run")


def _changed(
    folder: Path, item: str, state: StageState, deep: bool, looked: Looked
) -> Fault | None:
    if item not in state.made:
        return _shard_fault(folder, item, deep)
    marks = state.made[item].files
    there = {path.relative_to(folder).as_posix(): path for path in files_of(folder)}
    gone = sorted(marks.keys() - there.keys())
    other = [n for n in sorted(marks.keys() & there.keys())
             if _differs(there[n], marks[n], deep, looked)]  # fmt: skip
    foreign = tuple(sorted(there.keys() - marks.keys()))
    words = [f"{_names(gone)} gone"] * bool(gone)
    words += [f"{_names(other)} not as published"] * bool(other)
    words += [f"{_names(foreign)} written by no run"] * bool(foreign)
    if words:
        kind = "missing" if gone else "changed" if other else "foreign"
        return Fault(item, kind, ", ".join(words), foreign)
    return _shard_fault(folder, item, deep)


def _differs(path: Path, mark: FileMark, deep: bool, looked: Looked) -> bool:
    """Whether a file has other bytes; a copy has another time, so time alone is no evidence."""
    stat = path.stat()
    looked.files += 1
    looked.bytes += stat.st_size
    if stat.st_size != mark.size:
        return True
    if not deep and stat.st_mtime_ns == mark.mtime_ns:
        return False
    looked.hashed += stat.st_size
    return file_sha256(path) != mark.sha256


def _shard_fault(folder: Path, item: str, deep: bool) -> Fault | None:
    """What the shards' own checksums say: all of them, or only whether index and sizes fit."""
    if not (folder / "index.json").is_file() or not (folder / "manifest.json").is_file():
        return None
    if deep:
        faults = verify(folder)
    else:
        try:
            read_entries(folder)
            faults = []
        except FormatError as error:
            faults = [str(error)]
    more = f" and {len(faults) - 1} more" if len(faults) > 1 else ""
    return Fault(item, "shards", faults[0] + more) if faults else None


def _names(names: list[str] | tuple[str, ...]) -> str:
    """A few names, then a count."""
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more + (" is" if len(names) == 1 else " are")
