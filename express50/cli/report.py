"""``express50 report``: write the page."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from express50.contract.layout import Dataset
from express50.errors import StageError


def add_commands(subparsers: argparse._SubParsersAction) -> None:
    """Add ``report``."""
    parser = subparsers.add_parser(
        "report", help="gather QC into one self-contained HTML page", description=run_report.__doc__
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--out", type=Path, help="folder of the page (default: DATASET/report)")
    parser.add_argument("--title", help="heading of the page")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(handler=run_report)


def run_report(args: argparse.Namespace) -> int:
    """Write DATASET/report/index.html from what the stages left behind."""
    from express50.dataset.report.page import render_page
    from express50.files.atomic import write_bytes

    dataset = Dataset(args.dataset)
    if not dataset.subjects():
        raise StageError(f"{args.dataset}: nothing is ingested; run 'express50 ingest' first")
    path = (args.out or dataset.report_dir) / "index.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, render_page(dataset, args.title).encode())
    size = path.stat().st_size
    print(
        json.dumps({"report": str(path), "bytes": size})
        if args.json
        else f"{path} ({size:,} bytes)"
    )
    return 0
