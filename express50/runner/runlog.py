"""What a run is doing, for those who look on: kept in the ledger by a thread of its own.

A stage may hold the main thread for minutes; a sign of life every two seconds tells it from a run
that was killed.
"""

from __future__ import annotations

import contextlib
import sqlite3
import threading
import time
from dataclasses import replace
from pathlib import Path

from express50.runner.ledger import Ledger
from express50.runner.receipts import Run

BEAT_SECONDS = 2.0


class RunLog:
    """One run of a stage, in the ledger's table of runs."""

    def __init__(self, ledger: Path, stage: str, items: int) -> None:
        now = time.time()
        self._path = ledger
        self._run = Run(stage=stage, items=items, begun=now, seen=now)
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="run log", daemon=True)

    def __enter__(self) -> RunLog:
        self._thread.start()
        return self

    def __exit__(self, *unused: object) -> None:
        with self._lock:
            self._run = replace(self._run, running={}, ended=time.time())
        self._over.set()
        self._thread.join()

    def current(self, count: int) -> None:
        """So many items are up to date already."""
        with self._lock:
            self._run = replace(self._run, current=self._run.current + count)

    def begin(self, item: str) -> None:
        """An item is worked at."""
        with self._lock:
            self._run.running[item] = time.time()

    def settle(self, item: str) -> None:
        """An item is done, or failed."""
        with self._lock:
            self._run.running.pop(item, None)

    def _beat(self) -> None:
        with Ledger(self._path) as ledger:
            over = False
            while True:
                with self._lock:
                    run = replace(self._run, seen=time.time(), running=dict(self._run.running))
                with contextlib.suppress(sqlite3.OperationalError):  # the run itself will say so
                    ledger.write_run(run)
                if over:
                    return
                over = self._over.wait(BEAT_SECONDS)
