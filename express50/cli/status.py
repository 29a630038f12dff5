"""``express50 status``: what is done, failed, running and missing, as a table or a live page."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from express50.console import FAILED, OK, format_table, say, say_json
from express50.contract.extensions import stages
from express50.contract.layout import Dataset, existing_dataset
from express50.errors import ConfigError
from express50.runner.ledger import Ledger, Receipt
from express50.runner.status import StageStatus, read_status

PAGE_SECONDS = 3.0  # between two pages while a run goes on


def add_commands(subparsers: Any) -> None:
    """Add ``status`` and ``info``."""
    parser = subparsers.add_parser("status", help="what is done, what failed, time and memory")
    parser.add_argument("dataset", type=Path, metavar="DATASET")
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--json", action="store_true", help="print receipts as JSON")
    how.add_argument("--page", type=Path, metavar="FILE", help="HTML page, kept up while a run is")
    how.add_argument("--serve", type=int, metavar="PORT", help="the page on http://127.0.0.1:PORT")
    parser.set_defaults(handler=show_status)
    parser = subparsers.add_parser("info", help="subjects, cameras, frames and expressions")
    parser.add_argument("dataset", type=Path, metavar="DATASET")
    parser.add_argument("--json", action="store_true", help="print as JSON")
    parser.set_defaults(handler=show_info)


def show_status(args: argparse.Namespace) -> int:
    """Print or publish how far the stages are; exit code 1 when an item's last run failed."""
    dataset = existing_dataset(args.dataset)
    if args.serve is not None:
        return _serve(dataset, args.serve)
    if args.page is not None:
        table = _keep_page(dataset, args.page)
    else:
        table = _read(dataset)
        if args.json:
            say_json({row.stage: [_row(r) for r in row.receipts] for row in table})
        else:
            say(*_lines(table))
    return FAILED if any(row.failed for row in table) else OK


def _read(dataset: Dataset) -> list[StageStatus]:
    with Ledger(dataset.ledger, read_only=True) as ledger:
        return read_status(ledger, list(stages()))


def _page(dataset: Dataset, live: bool | None) -> tuple[str, list[StageStatus]]:
    """The page and what is on it; it loads itself again if ``live``, None: while a run goes on."""
    from express50.runner.status import status_page

    table = _read(dataset)
    again = any(row.state == "running" for row in table) if live is None else live
    name = dataset.root.resolve().name
    return status_page(name, table, PAGE_SECONDS if again else None), table


def _keep_page(dataset: Dataset, path: Path) -> list[StageStatus]:
    from express50.runner.status import write_page

    said = False
    while True:
        text, table = _page(dataset, None)
        write_page(path, text)
        if not said:
            say(f"wrote {path}")
        if not any(row.state == "running" for row in table):
            return table
        if not said:
            say("keeping it up to date until the run ends; Ctrl-C stops that, not the run")
        said = True
        time.sleep(PAGE_SECONDS)


def _serve(dataset: Dataset, port: int) -> int:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:  # noqa: N802
            if self.path != "/":
                self.send_error(404)
                return
            body = _page(dataset, True)[0].encode()
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *unused: object) -> None:
            """Nothing: the page asks every few seconds."""

    try:
        server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
    except (OSError, OverflowError) as error:
        raise ConfigError(f"--serve {port}: {error}; choose another port") from error
    with server:
        say(f"http://127.0.0.1:{server.server_port} (Ctrl-C stops it)")
        server.serve_forever()
    return OK


def _lines(table: list[StageStatus]) -> Iterable[str]:
    header = ["stage", "done", "failed", "running", "missing", "seconds", "peak MB", "state"]
    rows = [
        [
            row.stage,
            *(str(n) for n in (row.done, len(row.failed), len(row.running), row.missing)),
            f"{row.seconds:.1f}",
            f"{row.peak_memory / 1e6:.0f}",
            row.state,
        ]
        for row in table
    ]
    yield from format_table(header, rows)
    for row in table:
        for receipt in row.failed:
            yield f"failed {receipt.stage} {receipt.item}: {receipt.reason}"


def _row(receipt: Receipt) -> dict[str, Any]:
    """A receipt but for its files, which ``express50 check`` looks at."""
    return {name: value for name, value in vars(receipt).items() if name != "made"}


def show_info(args: argparse.Namespace) -> int:
    """Print what was ingested."""
    from express50.capture.index import read_index

    dataset = existing_dataset(args.dataset)
    indices = [read_index(dataset, subject) for subject in dataset.subjects()]
    header = ["subject", "cameras", "size", "frames", "expressions", "plates", "calibration"]
    rows = [[str(value) for value in _info(index).values()] for index in indices]
    if args.json:
        say_json([_info(index) for index in indices])
    else:
        say(*format_table(header, rows))
    return OK


def _info(index: Any) -> dict[str, Any]:
    sizes = sorted({f"{c.width}x{c.height}" for c in index.cameras.values()})
    return {
        "subject": index.subject,
        "cameras": len(index.cameras),
        "size": ",".join(sizes),
        "frames": index.frames,
        "expressions": len(index.cues),
        "plates": len(index.plates),
        "calibration": "given" if index.calibration else "board" if index.board else "none",
    }
