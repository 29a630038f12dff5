"""The state of a dataset, from its ledger alone, as records and as a self-contained page."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from express50.files.atomic import write_bytes
from express50.runner.ledger import Ledger, Receipt, Run
from express50.runner.progress import format_rate

SILENT_SECONDS = 15.0  # a run that shows no sign for so long was killed
RECENT = 50  # items whose rate counts for the time left


@dataclass(frozen=True, kw_only=True)
class StageStatus:
    """The progress of one stage.

    Attributes:
        stage: stage name.
        state: ``running``, ``stopped`` (its run was killed), ``failed`` (items did), ``done``, or
            ``not run``.
        done: items that are.
        failed: receipts of items that are not.
        running: when each item that is worked at was begun, seconds since 1970.
        missing: items of the last run that wait or were left when it was stopped.
        rate: items a second of late; 0 while none has ended.
        left_s: seconds until the run ends at that rate, None where that is not known.
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


FAILED_SHOWN = 200
SLOWEST_SHOWN = 10
RUNNING_SHOWN = 40


def status_page(name: str, table: Sequence[StageStatus], refresh_s: float | None) -> str:
    """Render the page.

    Args:
        name: of the dataset.
        table: its stages.
        refresh_s: seconds until a browser loads it again; None if it stays as it is.
    """
    import jinja2

    now = time.time()
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("express50.runner", "."), autoescape=True, trim_blocks=True
    )
    states = {stage.state for stage in table}
    failed = [receipt for stage in table for receipt in stage.failed]
    receipts = [receipt for stage in table for receipt in stage.receipts]
    slowest = sorted(receipts, key=lambda r: (-r.seconds, r.stage, r.item))[:SLOWEST_SHOWN]
    working = [
        {"stage": stage.stage, "item": item, "for": format_seconds(now - since)}
        for stage in table
        for item, since in sorted(stage.running.items(), key=lambda pair: pair[1])
    ]
    return environment.get_template("status_page.html").render(
        name=name,
        state=next((s for s in ("running", "stopped", "failed", "done") if s in states), "not run"),
        time=time.strftime("%Y-%m-%d %H:%M:%S %Z", time.localtime(now)),
        refresh=refresh_s,
        cards=_cards(table, receipts),
        stages=[_row(stage) for stage in table],
        working=working[:RUNNING_SHOWN],
        more_working=max(0, len(working) - RUNNING_SHOWN),
        failed=failed[:FAILED_SHOWN],
        more_failed=max(0, len(failed) - FAILED_SHOWN),
        slowest=[
            vars(receipt)
            | {
                "seconds": format_seconds(receipt.seconds),
                "share": round(100 * receipt.seconds / max(slowest[0].seconds, 1e-9), 1),
                "memory": format_memory(receipt.peak_memory),
            }
            for receipt in slowest
        ],
    )


def write_page(path: Path, text: str) -> None:
    """Write a page in one step: a browser sees the old one or the new."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, text.encode())
    os.chmod(path, 0o644)  # noqa: PTH101


def format_seconds(seconds: float) -> str:
    """A duration for people: ``42 s``, ``3:05 min``, ``2:10 h``, ``3 d 4 h``."""
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    if whole < 86400:
        return f"{whole // 3600}:{whole % 3600 // 60:02d} h"
    return f"{whole // 86400} d {whole % 86400 // 3600} h"


def format_memory(count: float) -> str:
    """Bytes for people, in units of 1000."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB" if count else ""


def _cards(table: Sequence[StageStatus], receipts: Sequence[Receipt]) -> list[tuple[str, str]]:
    current = next((stage for stage in table if stage.state == "running"), None)
    cards = [
        ("done", f"{sum(stage.done for stage in table):,}"),
        ("failed", f"{sum(len(stage.failed) for stage in table):,}"),
        ("running", f"{sum(len(stage.running) for stage in table):,}"),
        ("missing", f"{sum(stage.missing for stage in table):,}"),
    ]
    if current is not None:
        left = "" if current.left_s is None else format_seconds(current.left_s)
        cards.append((f"left of {current.stage}", left or "not known yet"))
    most = max((receipt.peak_memory for receipt in receipts), default=0)
    return [*cards, ("peak memory of an item", format_memory(most) or "none")]


def _row(stage: StageStatus) -> dict[str, Any]:
    counts = {
        "done": stage.done,
        "failed": len(stage.failed),
        "running": len(stage.running),
        "missing": stage.missing,
    }
    total = sum(counts.values())
    return counts | {
        "stage": stage.stage,
        "state": stage.state,
        "words": "some failed" if stage.state == "failed" else stage.state,
        "shares": [(k, round(100 * n / total, 3)) for k, n in counts.items() if n],
        "rate": format_rate(1, 1 / stage.rate) if stage.rate > 0 else "",
        "left": "" if stage.left_s is None else format_seconds(stage.left_s),
        "seconds": format_seconds(stage.seconds) if stage.receipts else "",
        "memory": format_memory(stage.peak_memory),
    }
