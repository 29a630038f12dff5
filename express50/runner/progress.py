"""Show a stage's progress as a bar or lines, and record it in the ledger for other processes."""

from __future__ import annotations

import contextlib
import itertools
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from express50.console import log
from express50.errors import DiskFullError, FormatError
from express50.runner.ledger import Ledger, Receipt, Run

BEAT_SECONDS = 2.0


@contextlib.contextmanager
def showing(stage: str, total: int, enabled: bool) -> Iterator[Callable[[Receipt], None]]:
    """Show finished items on standard error: a bar in a terminal, else lines.

    Yields the function that takes the receipt of each.
    """
    in_terminal = enabled and total > 0 and sys.stderr.isatty()
    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
        TimeElapsedColumn(), "elapsed,", TimeRemainingColumn(), "left",
    )  # fmt: skip
    bar = Progress(*columns, console=Console(stderr=True))  # shows nothing until it is entered
    task, settled = bar.add_task(stage, total=total), itertools.count(1)

    def show(receipt: Receipt) -> None:
        restored = receipt.status == "done" and not receipt.attempts
        how = "restored" if restored else f"{receipt.status} {receipt.seconds:.1f} s"
        line = f"{receipt.stage} {next(settled)}/{total} {receipt.item} {how}"
        line += f": {receipt.reason}" if receipt.reason else ""
        bar.advance(task)
        if enabled and not in_terminal:
            log(line)
        elif in_terminal and receipt.status == "failed":
            bar.console.print(line, markup=False, highlight=False, soft_wrap=True)

    with bar if in_terminal else contextlib.nullcontext():
        yield show


class RunLog:
    """One run of a stage, in the ledger's table of runs.

    Until `current` is called, ``made`` items count as up to date.
    """

    def __init__(self, ledger: Path, stage: str, items: int, made: int = 0) -> None:
        now = time.time()
        self._path = ledger
        self._run = Run(stage=stage, items=items, current=made, begun=now, seen=now)
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
        """Say how many items are up to date already."""
        with self._lock:
            self._run = replace(self._run, current=count)

    def begin(self, item: str) -> None:
        """Note that an item is being worked on."""
        with self._lock:
            self._run.running[item] = time.time()

    def settle(self, item: str) -> None:
        """Note that an item is done, or failed."""
        with self._lock:
            self._run.running.pop(item, None)

    def _beat(self) -> None:
        trouble = FormatError, DiskFullError  # the run itself will say so
        with contextlib.suppress(*trouble), Ledger(self._path) as ledger:
            over = False
            while True:
                with self._lock:
                    run = replace(self._run, seen=time.time(), running=dict(self._run.running))
                with contextlib.suppress(*trouble):
                    ledger.write_run(run)
                if over:
                    return
                over = self._over.wait(BEAT_SECONDS)
