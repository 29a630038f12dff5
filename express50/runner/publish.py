"""Publish outputs safely: items appear complete, in one rename, and each stage runs once at a time.

Outputs that were replaced are kept in a store, so that going back to their settings or inputs is a
rename. An entry of this store is an output's folder with its receipt, named by its fingerprint.
Losing an entry does no harm, because a missing or damaged output is made again. The store is
therefore emptied when disk space runs low.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import shutil
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import IO
from urllib.parse import quote, unquote

from express50.contract.layout import Dataset
from express50.errors import DiskFullError, Express50Error, FormatError, StageError
from express50.files.atomic import (
    FORMER,
    folder_in_one_step,
    free_space,
    lock_file,
    naming_full_disk,
    put_back,
    sync_directory,
    write_json,
)
from express50.files.digests import file_sha256, files_of
from express50.files.text import read_json_table
from express50.runner.ledger import FileMark, Ledger, Made, Receipt

ASIDE = re.compile(rf"(.+)-[0-9a-f]{{32}}({re.escape(FORMER)})?")
GLANCE_SECONDS = 0.05
GENERATIONS = 2  # replaced outputs per item; more would keep mistakes rather than choices
LEAST_ROOM = 2e9  # bytes; with less left on the disk the store is emptied
RECEIPT = ".receipt.json"
RESERVE_BYTES = 1_000_000  # for the receipt of an output that fills the disk
Keep = Callable[[Path], None]


@contextmanager
def run_folder(dataset: Dataset, stage: str) -> Iterator[Path]:
    """Yield a run's own folder, which its workers need to publish.

    A worker may outlive its run, or be given up as dead while it still works. Once the folder is
    gone, at the end of the run or when the next one begins, such a worker can no longer publish.

    Meanwhile some space is held for the receipt of an output that fills the disk.
    """
    folder = dataset.staging_dir / f"{stage}-{uuid.uuid4().hex}"
    folder.mkdir(parents=True)
    try:
        with naming_full_disk(dataset.root):
            _reserve(dataset, stage).write_bytes(os.urandom(RESERVE_BYTES))  # zeros may be no space
        yield folder
    except BaseException:
        with suppress(OSError):  # of a full or broken disk: the first error says so
            clean_leftovers(dataset, stage)
        raise
    clean_leftovers(dataset, stage)


@contextmanager
def publishing(
    folder: Path, dataset: Dataset, stage: str, item: str, keep: Keep | None = None
) -> Iterator[Path]:
    """Yield a temporary folder; on a clean exit it becomes the item's folder in one rename.

    It is made in a run's ``folder``. If the body raises, the item's former folder stays. A former
    folder that was replaced is deleted, unless ``keep`` moves it to another place.
    """
    aside = folder / f"{quote(item, safe='+')}-{uuid.uuid4().hex}"
    with folder_in_one_step(aside, dataset.item_dir(stage, item), keep):
        yield aside


def set_aside(dataset: Dataset, stage: str, item: str, keep: Keep | None = None) -> None:
    """Move a published item to the stale folder, so that no later stage reads it.

    ``keep`` may move it on from there.
    """
    target = dataset.item_dir(stage, item)
    if not target.exists():
        return
    discard_stale(dataset, stage, item)
    stale = dataset.stale_dir / stage / item
    stale.parent.mkdir(parents=True, exist_ok=True)
    target.rename(stale)
    sync_directory(target.parent)
    folder = target.parent  # empty folders of nested items must not be taken for items
    while folder != dataset.stage_dir(stage) and not any(folder.iterdir()):
        folder.rmdir()
        folder = folder.parent
    if keep is not None:
        keep(stale)


def discard_stale(dataset: Dataset, stage: str, item: str) -> None:
    """Delete the stale output that an earlier failure of an item left."""
    shutil.rmtree(dataset.stale_dir / stage / item, ignore_errors=True)


def record_published(dataset: Dataset, ledger: Ledger, receipt: Receipt) -> None:
    """Store the receipt of a published item; what its earlier failures left is deleted.

    Without a receipt, the item would be made again. If the output has filled the disk, the receipt
    takes the space that the run holds for it (`run_folder`).
    """
    discard_stale(dataset, receipt.stage, receipt.item)
    dataset.log_file(receipt.stage, receipt.item).unlink(missing_ok=True)
    try:
        ledger.write(receipt)
    except DiskFullError:
        _reserve(dataset, receipt.stage).unlink(missing_ok=True)
        ledger.write(receipt)
    if receipt.made is not None:
        ledger.know(dataset.item_dir(receipt.stage, receipt.item), receipt.made.files)


def _reserve(dataset: Dataset, stage: str) -> Path:
    return dataset.staging_dir / f".{stage}.reserve"


def leftovers(dataset: Dataset, stage: str) -> list[Path]:
    """Return the folders that interrupted runs of a stage left in staging."""
    own = re.compile(rf"{re.escape(stage)}-(leftovers-)?[0-9a-f]{{32}}")  # of no stage `x-...`
    return [path for path in dataset.staging_dir.glob(f"{stage}-*") if own.fullmatch(path.name)]


def clean_leftovers(dataset: Dataset, stage: str) -> None:
    """Delete what killed runs of one stage left unfinished; the caller holds the stage's lock.

    It is renamed first, so that no worker publishes what is being deleted. Published folders that a
    kill between two renames left beside their place are put back.
    """
    _reserve(dataset, stage).unlink(missing_ok=True)
    left = leftovers(dataset, stage)
    if not left:
        return
    taken = dataset.staging_dir / f"{stage}-leftovers-{uuid.uuid4().hex}"
    taken.mkdir()
    for folder in left:
        _empty(folder, taken)
    for path in sorted(taken.iterdir(), key=lambda path: not path.name.endswith(FORMER)):
        name = ASIDE.fullmatch(path.name)
        item = unquote(name[1]) if name else ""
        if not item or ".." in item.split("/"):
            continue
        target = dataset.item_dir(stage, item)
        if name and name[2]:
            put_back(path, target)
        if target.parent.is_dir():  # what is deleted next must not come back after a power failure
            sync_directory(target.parent)
    shutil.rmtree(taken, ignore_errors=True)


def _empty(folder: Path, taken: Path) -> None:
    """Move a run's files to ``taken`` and remove its folder; workers may still be adding files."""
    while folder.is_dir():
        for path in folder.iterdir():
            same = (taken / path.name).exists()
            with suppress(FileNotFoundError):
                path.rename(taken / (uuid.uuid4().hex if same else path.name))
        try:
            folder.rmdir()
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOENT):
                raise


@contextmanager
def stage_lock(dataset: Dataset, stage: str) -> Iterator[None]:
    """Lock a stage of a dataset; the system releases the lock however the process ends.

    Raises:
        StageError: another process holds it.
    """
    path = dataset.staging_dir / f".{stage}.lock"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        if not _locked(file, path):
            time.sleep(GLANCE_SECONDS)  # perhaps `is_running` has just looked
            if not _locked(file, path):
                raise StageError(
                    f"{dataset.root}: another '{stage}' is running on this dataset; wait until it"
                    " ends"
                )
        yield


def _locked(file: IO[str], path: Path, kind: int = fcntl.LOCK_EX) -> bool:
    try:
        lock_file(file, path, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


@contextmanager
def hold_stages(dataset: Dataset, names: Iterable[str]) -> Iterator[None]:
    """Lock several stages, so that none of them can start; StageError if one is running."""
    with ExitStack() as stack:
        for name in names:
            stack.enter_context(stage_lock(dataset, name))
        yield


def is_running(dataset: Dataset, stage: str) -> bool:
    """Return whether some process runs a stage at this moment."""
    path = dataset.staging_dir / f".{stage}.lock"
    if not path.is_file():
        return False
    with path.open("r") as file:
        # The lock is shared and released at once; a stage that starts meanwhile tries again.
        return not _locked(file, path, fcntl.LOCK_SH)


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
    goes into the store in exchange. The receipt has 0 attempts, as nothing was made; it is None if
    the store has no such output. A damaged one is deleted.
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


def is_kept(dataset: Dataset, stage: str, item: str, fingerprint: str) -> bool:
    """Return whether the store has an output with this fingerprint."""
    return _entry(dataset, stage, item, fingerprint).is_dir()


def make_room(dataset: Dataset) -> bool:
    """Empty the store if the disk is nearly full; return whether it was."""
    short = free_space(dataset.root) < LEAST_ROOM
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
