"""How far a dataset is, from its ledger alone; others may be writing it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from express50.runner.ledger import Ledger
from express50.runner.receipts import Receipt, Run

SILENT_SECONDS = 15.0  # a run that shows no sign for so long was killed
RECENT = 50  # items whose rate counts for the time left


@dataclass(frozen=True, kw_only=True)
class StageStatus:
    """How far one stage is.

    Attributes:
        stage: stage name.
        state: ``running``, ``stopped`` (its run was killed), ``failed`` (items did), ``done``, or
            ``not run``.
        done: items that are.
        failed: receipts of items that are not.
        running: when each item that is worked at was begun, seconds since 1970.
        missing: items of the last run that wait or were left when it was stopped.
        rate: items a second of late; 0 while none has ended.
        left_s: seconds until the run ends at that rate, None where that cannot be told.
        seconds: work of all items.
        peak_memory: of the item that took most, bytes.
        receipts: all of them.
    """

    stage: str
    state: str
    done: int
    failed: tuple[Receipt, ...]
    running: dict[str, float]
    missing: int
    rate: float
    left_s: float | None
    seconds: float
    peak_memory: int
    receipts: tuple[Receipt, ...]


def read_status(
    ledger: Ledger, stages: Sequence[str], now: float | None = None
) -> list[StageStatus]:
    """The StageStatus of every stage, in order; ``now`` is in seconds since 1970."""
    moment = time.time() if now is None else now
    runs = ledger.runs()
    return [_stage(name, ledger.read(name), runs.get(name), moment) for name in stages]


def _stage(name: str, table: dict[str, Receipt], run: Run | None, now: float) -> StageStatus:
    receipts = tuple(table.values())
    alive = run is not None and not run.ended and now - run.seen < SILENT_SECONDS
    settled = [r.time for r in receipts if run is not None and r.time >= run.begun]
    # An item may be in the ledger before the run's next sign says that it is over.
    began = run.running if run is not None and alive else {}
    running = {k: t for k, t in began.items() if k not in table or table[k].time < t}
    open_items = max(0, run.items - run.current - len(settled)) if run is not None else 0
    rate = _rate(settled, run.begun, now if alive else run.ended or run.seen) if run else 0.0
    failed = tuple(r for r in receipts if r.status == "failed")
    # Items that wait to be made anew have their former receipts still.
    former = 0
    if run is not None:
        older = sum(r.status == "done" and r.time < run.begun for r in receipts)
        former = min(open_items, max(0, older - run.current))
    return StageStatus(
        stage=name,
        state=_state(run, alive, open_items, failed, receipts),
        done=len(receipts) - len(failed) - former,
        failed=failed,
        running=running,
        missing=max(0, open_items - len(running)),
        rate=rate,
        left_s=open_items / rate if alive and rate > 0 else None,
        seconds=sum(r.seconds for r in receipts),
        peak_memory=max((r.peak_memory for r in receipts), default=0),
        receipts=receipts,
    )


def _state(
    run: Run | None, alive: bool, open_items: int, failed: Sequence, receipts: Sequence
) -> str:
    if alive:
        return "running"
    if run is not None and not run.ended or open_items:
        return "stopped"
    return "failed" if failed else "done" if receipts else "not run"


def _rate(ends: list[float], begun: float, now: float) -> float:
    """Items a second over the last ones, up to now: it sinks while nothing ends."""
    recent = sorted(ends)[-RECENT - 1 :]
    if len(recent) <= RECENT:  # the start of the run counts as an end
        recent = [begun, *recent]
    return (len(recent) - 1) / max(now - recent[0], 1e-3) if ends else 0.0
