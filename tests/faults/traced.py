"""Record what a run really does to the disk, in the words of `tests.faults.protocol`.

System calls are looked at, not the code that makes them: renames, syncs, locks, SQL statements.
"""

from __future__ import annotations

import fcntl
import io
import os
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path

import pytest

from express50.contract.layout import Dataset
from express50.files import atomic
from express50.files.atomic import FORMER
from tests.faults.protocol import BEFORE_RENAME

MERGED = {
    "driver: look",
    "driver: take away",
    "worker: write",
    "worker: sync files",
}  # several calls
AFTER_RENAME = ("worker: rename", "worker: swap")


class Recorder:
    """Notes steps of one stage's only item; ``before`` is called ahead of each call."""

    def __init__(self, dataset: Dataset, stage: str, item: str, swaps: bool) -> None:
        self.steps: list[str] = []
        self.before: Callable[[], None] = lambda: None
        self.after: Callable[[str], None] = lambda step: None
        self._committing = False
        self._staging = dataset.staging_dir.resolve()
        self._stage, self._swaps = stage, swaps
        self._target = dataset.item_dir(stage, item).resolve()
        self._renamed = False  # what a worker does to its aside afterwards is no part of it

    def watch(self, patch: pytest.MonkeyPatch) -> None:
        """Put this between Python and the system."""

        def wrap(module: object, name: str, step_of: Callable[..., str | None]) -> None:
            real = getattr(module, name)

            def call(*args: object, **options: object) -> object:
                step = step_of(*args, **options)
                if step is not None:
                    self.before()
                result = real(*args, **options)
                if step and result is not False:
                    self._note(step)
                return result

            patch.setattr(module, name, call)

        for name in ("mkdir", "rmdir", "rename", "fsync"):
            wrap(os, name, getattr(self, f"_{name}"))
        wrap(os, "open", lambda *args, **options: None)
        wrap(os, "unlink", lambda *args, **options: "")
        wrap(io, "open", self._io_open)
        wrap(shutil, "rmtree", self._rmtree)
        if not self._swaps:  # as on file systems that cannot
            patch.setattr(atomic, "_swap", lambda one, other: False)
        wrap(atomic, "_swap", lambda one, other: "worker: swap")
        wrap(fcntl, "flock", self._flock)
        connect = sqlite3.connect

        def traced(*args: object, **options: object) -> sqlite3.Connection:
            database = connect(*args, **options)
            database.set_trace_callback(self._sql)
            return database

        patch.setattr(sqlite3, "connect", traced)

    def _note(self, step: str) -> None:
        self._renamed = step in AFTER_RENAME or (self._renamed and step != "worker: make aside")
        if self._renamed and step.split(": ")[1] in BEFORE_RENAME:
            return
        looks_again = step == "driver: look" and step in self.steps  # to know what it sets aside
        if looks_again or (step in MERGED and self.steps[-1:] == [step]):
            return
        self.steps.append(step)
        self.after(step)

    def _depth(self, path: object) -> tuple[str, int]:
        """Return whose folder a path is in, ``run`` or ``leftovers``, and how deep."""
        path = Path(str(path))
        if not path.is_relative_to(self._staging):
            return "", 0
        parts = path.relative_to(self._staging).parts
        if not parts or not parts[0].startswith(f"{self._stage}-"):
            return "", 0
        return ("leftovers" if "leftovers" in parts[0] else "run"), len(parts)

    def _mkdir(self, path: object, *_: object, **__: object) -> str:
        where = self._depth(path)
        if where == ("run", 1):
            return "driver: make the run's folder"
        if where == ("run", 2):
            return "worker: make aside"
        return "worker: write" if where[0] == "run" else ""

    def _rmdir(self, path: object, *_: object, **options: object) -> str:
        return "driver: remove the run's folder" if self._depth(path) == ("run", 1) else ""

    def _rename(self, one: object, other: object, **_: object) -> str:
        ends = self._depth(one)[0], self._depth(other)[0]
        if ends == ("run", "leftovers"):
            return "driver: take away"
        if ends == ("leftovers", ""):
            return "driver: restore"
        if ends == ("run", ""):
            return "worker: rename" if Path(str(other)) == self._target else "worker: delete aside"
        if Path(str(one)) == self._target:
            return "worker: rename old" if str(other).endswith(FORMER) else "driver: set aside"
        return "worker: write" if ends == ("", "run") else ""  # a replaced output comes back

    def _io_open(self, path: object, mode: str = "r", *_: object, **__: object) -> str:
        return "worker: write" if "w" in mode and self._depth(path)[0] == "run" else ""

    def _fsync(self, descriptor: int) -> str:
        path = Path(f"/proc/self/fd/{descriptor}").readlink()
        where, depth = self._depth(path)
        if where == "run":
            return "worker: sync entries" if depth == 2 else "worker: sync files"
        return "any: sync parent" if path == self._target.parent else ""

    def _rmtree(self, path: object, *_: object, **__: object) -> str:
        where = self._depth(path)
        if not Path(str(path)).exists():
            return ""
        return {("run", 2): "worker: delete aside", ("leftovers", 1): "driver: delete"}.get(
            where, ""
        )

    def _flock(self, *_: object) -> str:
        return "driver: lock"

    def _sql(self, statement: str) -> None:
        if statement.startswith("SELECT") and "FROM receipts" in statement:
            self._note("driver: look")
        elif statement.startswith(("INSERT OR REPLACE INTO receipts", "UPDATE receipts")):
            self.before()
            self._committing = True
        elif statement == "COMMIT" and self._committing:
            self._committing = False
            self._note("driver: commit")
