"""Whether the ledger can be read."""

from __future__ import annotations

import sqlite3
import time
from contextlib import closing
from pathlib import Path

from express50.errors import FormatError
from express50.layout import Dataset
from express50.ledger import Ledger


def ledger_fault(dataset: Dataset) -> str:
    """What is wrong with the ledger's file; empty when nothing is."""
    if not dataset.ledger.is_file():
        return "is not there; without it every output counts as made by nobody"
    try:
        with Ledger(dataset.ledger):
            pass
        with closing(sqlite3.connect(dataset.ledger)) as database:
            said = database.execute("PRAGMA integrity_check(1)").fetchone()[0]
            rows = database.execute("SELECT metrics FROM receipts").fetchall()
    except (FormatError, sqlite3.DatabaseError) as error:
        return f"cannot be read ({str(error).split(';')[0].split(': ', 1)[-1]})"
    return "" if said == "ok" and rows is not None else f"is damaged ({said})"


def set_ledger_aside(dataset: Dataset) -> Path:
    """Rename the ledger and its journals, so that stages start a new one; nothing is deleted."""
    aside = dataset.ledger.with_name(f"ledger.sqlite.unreadable-{int(time.time())}")
    for ending in ("", "-wal", "-shm"):
        path = dataset.ledger.with_name(dataset.ledger.name + ending)
        if path.exists():
            path.rename(aside.with_name(aside.name + ending))
    return aside
