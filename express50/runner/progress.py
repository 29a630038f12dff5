"""Show a stage's progress: a bar or lines for people, signs of life in the ledger for others."""

from __future__ import annotations

import contextlib
import sqlite3
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.progress import MofNCompleteColumn
from rich.progress import Progress as Bar

from express50.console import log
from express50.runner.ledger import Ledger, Receipt, Run

BEAT_SECONDS = 2.0


class Progress:
    """Counts settled items on standard error."""

    def __init__(self, stage: str, total: int, enabled: bool = True) -> None:
        self.stage = stage
        self.total = total
        self.settled = 0
        self.enabled = enabled
        self._bar: Bar | None = None

    def __enter__(self) -> Progress:
        if self.enabled and self.total and sys.stderr.isatty():
            columns = (*Bar.get_default_columns(), MofNCompleteColumn())
            self._bar = Bar(*columns, console=Console(stderr=True))
            self._bar.add_task(self.stage, total=self.total)
            self._bar.start()
        return self

    def __exit__(self, *unused: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def settle(self, receipt: Receipt) -> None:
        """Show that an item ended."""
        self.settled += 1
        line = f"{receipt.stage} {self.settled}/{self.total} {receipt.item} {receipt.status}"
        line += f" {receipt.seconds:.1f} s" + (f": {receipt.reason}" if receipt.reason else "")
        if self._bar is not None:
            self._bar.advance(self._bar.task_ids[0])
            if receipt.status == "failed":
                self._bar.console.print(line, markup=False, highlight=False, soft_wrap=True)
        elif self.enabled:
            log(line)


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
        """Count the items that are up to date already."""
        with self._lock:
            self._run = replace(self._run, current=self._run.current + count)

    def begin(self, item: str) -> None:
        """Note that an item is being worked on."""
        with self._lock:
            self._run.running[item] = time.time()

    def settle(self, item: str) -> None:
        """Note that an item is done, or failed."""
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
