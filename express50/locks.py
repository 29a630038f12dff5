"""Locks of stages: two processes never run the same stage of a dataset."""

from __future__ import annotations

import fcntl
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager

from express50.errors import StageError
from express50.layout import Dataset


@contextmanager
def stage_lock(dataset: Dataset, stage: str) -> Iterator[None]:
    """Hold a stage of a dataset; the system lets go when the process ends, however it ends.

    Raises:
        StageError: another process holds it.
    """
    path = dataset.staging_dir / f".{stage}.lock"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StageError(
                f"{dataset.root}: another '{stage}' runs on this dataset; wait until it ends"
            ) from error
        yield


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
            # Shared, and let go at once: the stage itself must not find it taken.
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False
