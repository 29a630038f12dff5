"""Progress of a stage: a bar or lines for people, and signs of life in the ledger for onlookers."""

from __future__ import annotations

import contextlib
import sqlite3
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from express50.console import readers_may_leave
from express50.runner.ledger import Ledger, Receipt, Run


class Progress:
    """Counts settled items on standard error."""

    def __init__(self, stage: str, total: int, enabled: bool = True) -> None:
        self.stage = stage
        self.total = total
        self.settled = 0
        self.enabled = enabled
        self._bar: Any = None
        self._row: Any = None

    def __enter__(self) -> Progress:
        if self.enabled and self.total and sys.stderr.isatty():
            self._bar = make_bar()
            self._row = self._bar.add_task(self.stage, total=self.total, rate="")
            self._bar.start()
        return self

    def __exit__(self, *unused: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def settle(self, receipt: Receipt) -> None:
        """Show that an item ended."""
        self.settled += 1
        if self._bar is not None:
            self._bar.advance(self._row)
            self.tick()
        if not self.enabled:
            return
        if self._bar is None or receipt.status == "failed":
            line = describe(receipt, self.settled, self.total)
            if self._bar is not None:
                self._bar.console.print(line, markup=False, highlight=False, soft_wrap=True)
            else:
                with readers_may_leave(sys.stderr):
                    sys.stderr.write(line + "\n")
                    sys.stderr.flush()

    def tick(self) -> None:
        """Redraw rate and time left while nothing ends."""
        if self._bar is not None:
            task = self._bar.tasks[0]
            self._bar.update(self._row, rate=format_rate(self.settled, task.elapsed or 0.0))


def make_bar() -> Any:
    """Bar of rich on standard error."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as Bar

    return Bar(
        TextColumn("{task.description:<10}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )


def format_rate(count: int, seconds: float) -> str:
    """Items a second, or a minute where that is below one."""
    if count == 0 or seconds <= 0:
        return "-"
    rate = count / seconds
    return f"{rate:.1f}/s" if rate >= 1 else f"{rate * 60:.1f}/min"


def describe(receipt: Receipt, settled: int, total: int) -> str:
    """One line on a settled item."""
    line = f"{receipt.stage} {settled}/{total} {receipt.item} {receipt.status}"
    line += f" {receipt.seconds:.1f} s"
    return f"{line}: {receipt.reason}" if receipt.reason else line


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
