"""Keep outputs that were replaced, so that going back to their settings or inputs is a rename.

An entry of this store is an output's folder with its receipt, named by its fingerprint. Losing an
entry does no harm, because a missing or damaged output is made again. The store is therefore
emptied when disk space runs low.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path

from express50.contract.layout import Dataset
from express50.errors import DiskFullError, Express50Error, FormatError
from express50.files.atomic import write_json
from express50.files.digests import file_sha256, files_of
from express50.files.text import read_json_table
from express50.runner.ledger import FileMark, Made, Receipt
from express50.runner.publish import publishing

GENERATIONS = 2  # replaced outputs per item; more would keep mistakes rather than choices
LEAST_ROOM = 2e9  # bytes; with less left on the disk the store is emptied
RECEIPT = ".receipt.json"

Keep = Callable[[Path], None]


def keeping(dataset: Dataset, former: Receipt | None) -> Keep | None:
    """Return a function that moves the folder of a replaced output into the store.

    It moves nothing if there is little space; any other trouble only costs the entry. None for an
    output whose receipt is not known.
    """
    if former is None or former.made is None:
        return None
    entry = _entry(dataset, former.stage, former.item, former.fingerprint)

    def keep(folder: Path) -> None:
        with suppress(OSError, DiskFullError):  # others may empty the store meanwhile
            if make_room(dataset):
                return
            write_json(folder / RECEIPT, asdict(former))
            shutil.rmtree(entry, ignore_errors=True)
            entry.parent.mkdir(parents=True, exist_ok=True)
            folder.rename(entry)
            # The receipt's file was the last change in each.
            newest_first = sorted(entry.parent.iterdir(), key=lambda p: -p.stat().st_mtime_ns)
            for old in newest_first[GENERATIONS:]:
                shutil.rmtree(old, ignore_errors=True)

    return keep


def restore(
    folder: Path, dataset: Dataset, stage: str, item: str, fingerprint: str, former: Receipt | None
) -> Receipt | None:
    """Publish an output of the store again, if it has this fingerprint and all of its bytes.

    It is published through the run's ``folder``. The published output, whose receipt is ``former``,
    goes into the store in exchange.

    Returns:
        The receipt, with 0 attempts as nothing was made; None if the store has no such output.
        A damaged one is deleted.
    """
    entry = _entry(dataset, stage, item, fingerprint)
    if not entry.is_dir():
        return None
    try:
        row = read_json_table(entry / RECEIPT, FormatError)
        made = row.pop("made")
        marks = {name: FileMark(**mark) for name, mark in made.pop("files").items()}
        receipt = Receipt(**row, made=Made(files=marks, **made))
        found = {path.relative_to(entry).as_posix(): path for path in files_of(entry)}
        whole = {name: mark.sha256 for name, mark in marks.items()} == {
            name: file_sha256(path) for name, path in found.items()
        }
        asked = stage, item, fingerprint
        if whole and (receipt.stage, receipt.item, receipt.fingerprint) == asked:
            with publishing(folder, dataset, stage, item, keeping(dataset, former)) as out:
                entry.rename(out)  # over the empty folder, in one step
                (out / RECEIPT).unlink()
            return replace(receipt, reason="", attempts=0, time=time.time())
    except (OSError, Express50Error, TypeError, KeyError, AttributeError):
        pass  # it is made instead, which also says what is wrong with the disk
    shutil.rmtree(entry, ignore_errors=True)
    return None


def make_room(dataset: Dataset) -> bool:
    """Empty the store if the disk is nearly full; return whether it was."""
    usage = shutil.disk_usage(dataset.root)
    short = bool(usage.total) and usage.free < LEAST_ROOM
    if short:
        empty(dataset.replaced_dir)
    return short


def empty(folder: Path) -> tuple[int, int]:
    """Delete a folder of outputs as far as possible; return how many files and bytes that freed."""
    before = size_of(folder)
    shutil.rmtree(folder, ignore_errors=True)
    left = size_of(folder)
    return before[0] - left[0], before[1] - left[1]


def size_of(folder: Path) -> tuple[int, int]:
    """Count the files below a folder and their bytes."""
    sizes = []
    for path in folder.rglob("*"):
        with suppress(OSError):  # a run may take one out meanwhile
            if path.is_file():
                sizes.append(path.stat().st_size)
    return len(sizes), sum(sizes)


def _entry(dataset: Dataset, stage: str, item: str, fingerprint: str) -> Path:
    return dataset.replaced_dir / stage / item.replace("/", "+") / fingerprint
