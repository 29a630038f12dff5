"""Publish outputs safely: an item appears whole, in one rename; a stage runs once at a time."""

from __future__ import annotations

import fcntl
import shutil
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

from express50.contract.layout import Dataset
from express50.errors import StageError
from express50.files.atomic import folder_in_one_step, sync_directory


@contextmanager
def publishing(
    dataset: Dataset, stage: str, item: str, keep: Callable[[Path], None] | None = None
) -> Iterator[Path]:
    """Yield an empty folder aside; on a clean exit it becomes the item's folder in one rename.

    When the body raises, the item's former folder stays as it was. A former folder that was
    replaced is deleted, unless ``keep`` moves it to another place.
    """
    aside = dataset.staging_dir / f"{stage}-{item.replace('/', '+')}-{uuid.uuid4().hex}"
    with folder_in_one_step(aside, dataset.item_dir(stage, item), keep):
        yield aside


def set_aside(
    dataset: Dataset, stage: str, item: str, keep: Callable[[Path], None] | None = None
) -> None:
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
    """Delete what a former failure of an item set aside."""
    shutil.rmtree(dataset.stale_dir / stage / item, ignore_errors=True)


def clean_leftovers(dataset: Dataset, stage: str) -> None:
    """Delete unfinished outputs of killed runs of one stage."""
    for path in dataset.staging_dir.glob(f"{stage}-*"):
        shutil.rmtree(path, ignore_errors=True)


GLANCE_SECONDS = 0.05


@contextmanager
def stage_lock(dataset: Dataset, stage: str) -> Iterator[None]:
    """Hold a stage of a dataset; the system lets go when the process ends, however it ends.

    Raises:
        StageError: another process holds it.
    """
    path = dataset.staging_dir / f".{stage}.lock"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        if not _locked(file):
            time.sleep(GLANCE_SECONDS)  # perhaps `is_running` has just looked
            if not _locked(file):
                raise StageError(
                    f"{dataset.root}: another '{stage}' runs on this dataset; wait until it ends"
                )
        yield


def _locked(file: IO[str], kind: int = fcntl.LOCK_EX) -> bool:
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


@contextmanager
def hold_stages(dataset: Dataset, names: Iterable[str]) -> Iterator[None]:
    """Hold several stages, so that none of them runs meanwhile.

    Raises:
        StageError: one of them runs.
    """
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
        # Shared, and let go at once; a stage that starts meanwhile tries again.
        return not _locked(file, fcntl.LOCK_SH)
