"""Whether the ledger can be read."""

from __future__ import annotations

import os
import time
from pathlib import Path

from express50.contract.layout import Dataset
from express50.errors import FormatError
from express50.runner.ledger import Ledger


def ledger_fault(dataset: Dataset) -> str:
    """What is wrong with the ledger's file; empty when nothing is."""
    if not dataset.ledger.is_file():
        return "is not there; without it every output counts as made by nobody"
    try:
        with open_ledger(dataset) as ledger:
            ledger.check_whole()
    except FormatError as error:  # what to do about it, `--mend` knows better
        return str(error).removeprefix(f"{dataset.ledger}: ").split(";")[0]
    return ""


def open_ledger(dataset: Dataset) -> Ledger:
    """The ledger, to be written where that is allowed.

    A connection that only reads leaves journals behind that it may not remove, so it is for
    datasets of others.
    """
    return Ledger(dataset.ledger, read_only=not os.access(dataset.root, os.W_OK))


def set_ledger_aside(dataset: Dataset) -> Path:
    """Rename the ledger and its journals, so that stages start a new one; nothing is deleted."""
    aside = dataset.ledger.with_name(f"ledger.sqlite.unreadable-{int(time.time())}")
    for ending in ("", "-wal", "-shm"):
        path = dataset.ledger.with_name(dataset.ledger.name + ending)
        if path.exists():
            path.rename(aside.with_name(aside.name + ending))
    return aside
