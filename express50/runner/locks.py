"""Locks of stages: two processes never run the same stage of a dataset."""

from __future__ import annotations

import fcntl
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import IO

from express50.contract.layout import Dataset
from express50.errors import StageError

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


def _locked(file: IO[str]) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
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
    """Whether some process runs a stage at this moment."""
    path = dataset.staging_dir / f".{stage}.lock"
    if not path.is_file():
        return False
    with path.open("r") as file:
        try:
            # Shared, and let go at once; a stage that starts meanwhile tries again.
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False
