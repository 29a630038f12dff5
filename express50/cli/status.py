"""``express50 status`` shows what is done, failed, running and to do, as a table or a live page.

It reads only the ledger.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any

from rich.filesize import decimal

from express50.console import (
    FAILED,
    OK,
    add_command,
    answer,
    count,
    format_seconds,
    format_table,
    group_lines,
    number,
    say,
)
from express50.contract.layout import Dataset, check_page_file, existing_dataset
from express50.contract.stage import stages, typical_error
from express50.errors import few
from express50.files.atomic import write_bytes
from express50.local_server import NOT_FOUND, PageServer, Reply
from express50.runner.ledger import COLUMNS, Ledger, Receipt, Run
from express50.runner.outdated import outdated
from express50.runner.publish import is_running

PAGE_SECONDS = 3.0  # between two writes of the page during a run
SILENT_SECONDS = 15.0  # a run that has not updated the ledger for this long was killed
UNLOCKED_SECONDS = 5.0  # the same where nobody holds the stage's lock, as far as this machine sees
AHEAD_SECONDS = 600.0  # another machine's clock may be this far ahead; more: one was set back
RECENT = 50  # the time left is estimated from the rate of this many last items
FAILED_SHOWN = 200
SLOWEST_SHOWN = 10
RUNNING_SHOWN = 40


@dataclass(frozen=True, kw_only=True)
class StageStatus:
    """The progress of one stage."""

    stage: str
    # ``running``, ``stopped`` (its run was killed), ``failed`` (some items failed), ``done``, or
    # ``not run``
    state: str
    done: int  # number of finished items
    failed: tuple[Receipt, ...]  # items whose last attempt failed, unless they are running again
    running: dict[str, float]  # start of each item in progress, seconds since 1970
    # number of items of the last run that are waiting, or were not reached, and had not failed
    to_do: int
    rate: float  # recent items per second; 0 before the first has finished
    left_s: float | None  # estimated seconds until the run ends; None if unknown
    seconds: float  # total seconds of all items
    peak_memory: int  # largest peak memory of an item, bytes
    receipts: tuple[Receipt, ...]  # the receipts of all items

    def counts(self) -> dict[str, int]:
        """Return the number of items per outcome."""
        failed, running = len(self.failed), len(self.running)
        return {"done": self.done, "failed": failed, "running": running, "to do": self.to_do}

    def expected_error(self) -> str:
        """Return the median item's expected error in words; empty if the stage states none."""
        return str(typical_error(r.metrics for r in self.receipts) or "")


def add_commands(subparsers: Any) -> None:
    """Add ``status``."""
    words = "show what is done, failed or outdated, with expected errors, time and memory"
    parser = add_command(
        subparsers, "status", show_status, words, json=False,
        description="Show for each stage how many items are done, failed, running or to do, its"
        " time, memory and expected error; then what is outdated, and why. Exit code 1 if an item"
        " failed.",
    )  # fmt: skip
    page = "write an HTML page, and update it while a stage runs"
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--json", action="store_true", help="print the receipts as JSON")
    how.add_argument("--page", type=Path, metavar="FILE", help=page)
    serve = "serve the page on this port, to this machine only; 0: any free port"
    how.add_argument("--serve", type=number(0, 65535), metavar="PORT", help=serve)


def show_status(args: argparse.Namespace) -> int:
    """Print or publish the progress of the stages; return exit code 1 if an item failed."""
    dataset = Dataset(args.dataset)
    trials = [
        f"running {row.stage}: a trial that measures its settings on a few expressions, for"
        " 'run --budget' or 'tune'"
        for ledger in sorted(dataset.pilot_dir.glob("*/ledger.sqlite"))
        for row in _read(Dataset(ledger.parent))  # a trial is a dataset of its own
        if row.state == "running"
    ]
    if trials and not dataset.ledger.is_file():  # the first run still measures
        answer(args, {}, *trials)
        return OK
    dataset = existing_dataset(args.dataset)
    if args.serve is not None:
        return _serve(dataset, args.serve)
    if args.page is not None:
        check_page_file(args.page)
        table = _keep_page(dataset, args.page)
    else:
        table = _read(dataset)
        with Ledger(dataset.ledger, read_only=True) as ledger:
            why = {(s, i): w for s, i, w in outdated(dataset, list(stages().values()), ledger)}
        # This looks at receipts only; `express50 check` looks at files.
        rows = {
            s.stage: [
                {k: getattr(r, k) for k in COLUMNS} | {"outdated": why.get((s.stage, r.item), "")}
                for r in s.receipts
            ]
            for s in table
        }
        old = group_lines((f"{stage} {item}", words) for (stage, item), words in why.items())
        lines = [*_lines(table), *trials, *(f"outdated {line}" for line in old)]
        if why:
            lines.append(
                "the next run makes these again, or takes back kept outputs of the same settings"
            )
        answer(args, rows, *lines)
    return FAILED if any(row.failed for row in table) else OK


def _read(dataset: Dataset) -> list[StageStatus]:
    with Ledger(dataset.ledger, read_only=True) as ledger:
        return read_status(ledger, list(stages()), locked=lambda name: is_running(dataset, name))


def _keep_page(dataset: Dataset, path: Path) -> list[StageStatus]:
    """Rewrite the page every few seconds until no stage runs."""
    said = False
    while True:
        table = _read(dataset)
        runs = any(row.state == "running" for row in table)
        name = dataset.root.resolve().name
        write_bytes(path, status_page(name, table, PAGE_SECONDS if runs else None).encode())
        if not said:
            say(f"wrote {path}")
        if not runs:
            return table
        if not said:
            say("updating the page until the run ends; Ctrl-C stops the updates, not the run")
        said = True
        time.sleep(PAGE_SECONDS)


def _serve(dataset: Dataset, port: int) -> int:
    def get(path: str) -> Reply:
        if path:
            return NOT_FOUND
        page = status_page(dataset.root.resolve().name, _read(dataset), PAGE_SECONDS)
        return Reply(HTTPStatus.OK, "text/html; charset=utf-8", page.encode())

    with PageServer(get, None, "127.0.0.1", port) as server:
        say(f"{server.address} (Ctrl-C stops it)")
        server.serve_forever()
    return OK


def _lines(table: list[StageStatus]) -> Iterator[str]:
    header = ["stage", "done", "failed", "running", "to do"]
    header += ["seconds", "peak MB", "state", "expected error"]
    rows = []
    for row in table:
        counts = [str(count) for count in row.counts().values()]
        work = [f"{row.seconds:.1f}", f"{row.peak_memory / 1e6:.0f}"]
        rows.append([row.stage, *counts, *work, row.state, row.expected_error()])
    yield from format_table(header, rows)
    for row in table:
        if imported := sum(receipt.imported for receipt in row.receipts):
            yield f"imported {row.stage}: {imported} of its items were made by another tool"
    for row in table:
        notes = [
            (note["what"], r.item) for r in row.receipts for note in r.metrics.get("dropped", ())
        ]
        if notes:
            parts = few([f"{what} of {item}" for what, item in notes])
            yield f"dropped {row.stage}: {count(len(notes), 'part')}, {parts}; 'report' says why"
    failed = (receipt for row in table for receipt in row.failed)
    for line in group_lines((f"{one.stage} {one.item}", one.reason) for one in failed):
        yield f"failed {line}"


def read_status(
    ledger: Ledger,
    names: Sequence[str],
    now: float | None = None,
    locked: Callable[[str], bool] = lambda stage: True,
) -> list[StageStatus]:
    """Read the status of every stage, in order.

    ``now`` is in seconds since 1970; ``locked`` says whether some process holds a stage's lock.
    """
    moment = time.time() if now is None else now
    runs = ledger.runs()
    rows = []
    for name in names:
        silence = SILENT_SECONDS if locked(name) else UNLOCKED_SECONDS
        rows.append(_stage(name, ledger.read(name), runs.get(name), moment, silence))
    return rows


def _stage(
    name: str, table: dict[str, Receipt], run: Run | None, now: float, silence: float
) -> StageStatus:
    receipts = tuple(table.values())
    failed = {r.item: r for r in receipts if r.reason}
    alive, open_items, former, to_do, rate = False, 0, 0, 0, 0.0
    running: dict[str, float] = {}
    if run is not None:
        alive = not run.ended and -AHEAD_SECONDS < now - run.seen < silence
        settled = [r.time for r in receipts if r.time >= run.begun]
        # An item's receipt may be written before the run's next update says that it has ended.
        began = run.running if alive else {}
        running = {k: t for k, t in began.items() if k not in table or table[k].time < t}
        open_items = max(0, run.items - run.current - len(settled))
        # Up to now, so that the rate falls while no item ends; the run's start counts as an end.
        ends = [run.begun, *sorted(settled)][-RECENT - 1 :]
        until = now if alive else run.ended or run.seen
        rate = (len(ends) - 1) / max(until - ends[0], 1e-3)
        # Items waiting to be made again still have their old receipts: failed ones count as that,
        # the others as to do. (A run of some items may not include all that failed before.)
        old = [r for r in receipts if r.time < run.begun]
        fresh = max(0, open_items - sum(bool(r.reason) for r in old))
        former = min(fresh, max(0, sum(not r.reason for r in old) - run.current))
        to_do = max(0, fresh - len(running.keys() - failed.keys()))
    if alive:
        state = "running"
    elif open_items or (run is not None and not run.ended):
        state = "stopped"
    else:
        state = "failed" if failed else "done" if receipts else "not run"
    return StageStatus(
        stage=name,
        state=state,
        done=len(receipts) - len(failed) - former,
        failed=tuple(r for item, r in failed.items() if item not in running),
        running=running,
        to_do=to_do,
        rate=rate,
        left_s=open_items / rate if alive and rate > 0 else None,
        seconds=sum(r.seconds for r in receipts),
        peak_memory=max((r.peak_memory for r in receipts), default=0),
        receipts=receipts,
    )


def status_page(name: str, table: Sequence[StageStatus], refresh_s: float | None) -> str:
    """Render the page of a dataset's stages.

    The browser reloads it every ``refresh_s`` seconds; with None, never.
    """
    import jinja2

    now = time.time()
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("express50.cli", "."), autoescape=True, trim_blocks=True
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
        cards=_cards(table),
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
                "memory": decimal(receipt.peak_memory),
            }
            for receipt in slowest
        ],
    )


def _cards(table: Sequence[StageStatus]) -> list[tuple[str, str]]:
    names = ("done", "failed", "running", "to do")
    cards = [(name, f"{sum(stage.counts()[name] for stage in table):,}") for name in names]
    current = next((stage for stage in table if stage.state == "running"), None)
    if current is not None:
        left = "not known yet" if current.left_s is None else format_seconds(current.left_s)
        cards.append((f"left of {current.stage}", left))
    most = max((stage.peak_memory for stage in table), default=0)
    return [*cards, ("peak memory of an item", decimal(most))]


def _row(stage: StageStatus) -> dict[str, Any]:
    counts = stage.counts()
    total = sum(counts.values())
    rate = f"{stage.rate:.1f}/s" if stage.rate >= 1 else f"{60 * stage.rate:.1f}/min"
    return counts | {
        "stage": stage.stage,
        "state": stage.state,
        "words": "some failed" if stage.state == "failed" else stage.state,
        "shares": [(k, round(100 * n / total, 3)) for k, n in counts.items() if n],
        "rate": rate if stage.rate > 0 else "",
        "left": "" if stage.left_s is None else format_seconds(stage.left_s),
        "seconds": format_seconds(stage.seconds) if stage.receipts else "",
        "memory": decimal(stage.peak_memory) if stage.receipts else "",
        "error": stage.expected_error(),
    }
