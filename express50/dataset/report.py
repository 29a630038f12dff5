"""Write a self-contained HTML page on a dataset: QC per stage, and errors if truth exists."""

from __future__ import annotations

import base64
import io
from contextlib import suppress
from pathlib import Path

import jinja2
import matplotlib as mpl
from markupsafe import Markup

from express50.console import figure_label, format_seconds
from express50.contract.layout import Dataset
from express50.contract.stage import stages, typical_error
from express50.errors import CaptureError, FormatError
from express50.files.containers import read_srgb
from express50.files.images import encode_jpeg
from express50.files.text import is_number, parse_json, read_json_table, read_text
from express50.geometry.pixels import resize_area
from express50.geometry.sampling import evenly
from express50.runner.ledger import Ledger, Receipt

mpl.use("Agg")
from matplotlib.figure import Figure  # noqa: E402  the backend is chosen first

Picture = tuple[Path, str]  # a file and its caption

AGAIN = "run its stage again"
PICTURE_WIDTH = 900  # pixels; a page with forty embedded pictures stays below ten megabytes
PICTURES = 12  # per stage
ROWS = 12
COLUMNS = 8
PANELS = 4
BARS, BINS = 200, 40  # most bars of a panel
VIDEO_LIMIT = 8_000_000  # bytes
INK = "#2457a6"


def render_page(dataset: Dataset, title: str | None = None) -> str:
    """Return the whole page as text.

    Besides the stages' folders it reads these if they exist: ``summary.json`` (figures of the run),
    ``accuracy/`` (errors against truth, written by the benchmarks) and ``grmm/``.
    """
    receipts: dict[str, list[Receipt]] = {}
    if dataset.ledger.is_file():
        with Ledger(dataset.ledger, read_only=True) as ledger:
            receipts = {name: list(ledger.read(name).values()) for name in stages()}
    views = [_stage_view(dataset, name, receipts.get(name, [])) for name in stages()]
    # A stage whose items all failed has published nothing, but readers look for it first.
    views = [view for view in views if view["item_count"] or view["failed"]]
    summary = _table(dataset.root / "summary.json")
    accuracy_dir = dataset.root / "accuracy"
    measured = _table(accuracy_dir / "accuracy.json")
    accuracy = None
    if measured:
        pictures = evenly(_pictures_below(accuracy_dir, 24), PICTURES)
        accuracy = {"rows": _rows(measured), "pictures": [_embed(p) for p in pictures]}
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("express50.dataset", "."), autoescape=True
    )
    return environment.get_template("report_page.html").render(
        title=title or f"Dataset {dataset.root.resolve().name}",
        subtitle=", ".join(dataset.subjects()),
        cards=_cards(dataset, views, summary),
        stages=views,
        accuracy=accuracy,
        front=_front_view(_table(dataset.root / "dial" / "front.json")),
        grmm=_grmm_view(dataset.root / "grmm"),
    )


def _stage_view(dataset: Dataset, stage: str, receipts: list[Receipt]) -> dict:
    root = dataset.stage_dir(stage)
    paths = sorted(root.rglob("metrics.json")) if root.is_dir() else []
    metrics = {str(p.parent.relative_to(root)): _table(p) for p in paths}
    pictures = [
        (path, f"{item}: {path.stem.replace('_', ' ')}")
        for item in metrics
        for ending in ("jpg", "png")
        for path in sorted((root / item / "qc").glob(f"*.{ending}"))
    ]
    figures = {
        item: {key: float(value) for key, value in table.items() if is_number(value)}
        for item, table in metrics.items()
    }
    columns = list(dict.fromkeys(key for row in figures.values() for key in row))[:COLUMNS]
    shown = list(figures.items())[:ROWS]
    return {
        "name": stage,
        "purpose": stages()[stage].purpose,
        "item_count": len(metrics),
        "imported": sum(r.imported and not r.reason for r in receipts),
        "failed": [(r.item, r.reason) for r in receipts if r.reason],
        "dropped": _reasons(metrics, "dropped"),
        "noted": _reasons(metrics, "warnings"),
        "error": typical_error(metrics.values()) or "n/a",
        "seconds": number(round(sum(r.seconds for r in receipts), 1)),
        "columns": [figure_label(column) for column in columns],
        "rows": [
            {"item": item, "cells": [number(row.get(c)) for c in columns]} for item, row in shown
        ],
        "more_rows": len(figures) - len(shown),
        "plot": _metric_bars(figures, columns) if len(figures) > 1 else "",
        "pictures": [_embed(p) for p in evenly(pictures, PICTURES)],
        "picture_count": len(pictures),
    }


def _reasons(metrics: dict[str, dict], key: str) -> list[tuple[str, str, str]]:
    """List (item, what, why) for the rows under a key in all items' metrics."""
    return [
        (item, str(row.get("what")), str(row.get("why")))
        for item, table in metrics.items()
        for row in table.get(key, [])
        if isinstance(row, dict)
    ]


def _cards(dataset: Dataset, views: list[dict], summary: dict) -> list[dict[str, str]]:
    peaks = {s: _table(dataset.peaks_file(s)) for s in dataset.subjects()}
    cards: dict[str, object] = {
        "subjects": len(peaks),
        "expressions": len({e for table in peaks.values() for e in table}),
        "peak labels": sum(map(len, peaks.values())),
        "parts dropped": sum(len(view["dropped"]) for view in views),
    }
    seconds = summary.get("seconds")
    if isinstance(seconds, dict):
        cards["minutes in total"] = f"{sum(seconds.values()) / 60:.1f}"
    for key in ("train.psnr_heldout_view_db", "fit.psnr_db", "peak_memory_gib"):
        if summary.get(key) is not None:
            cards[figure_label(key)] = summary[key]
    return [{"label": label, "value": number(value)} for label, value in cards.items()]


def _grmm_view(root: Path) -> list[dict]:
    folders = [root, *(p for p in sorted(root.iterdir()) if p.is_dir())] if root.is_dir() else []
    parts = []
    for folder in folders:
        deep = folder != root
        metrics = _table(folder / "metrics.json")
        pictures = _pictures_below(folder, 8) if deep else []
        videos = [
            {"uri": _address("video/mp4", path.read_bytes()), "caption": _words(path.stem)}
            for path in (sorted(folder.rglob("*.mp4")) if deep else ())
            if path.stat().st_size <= VIDEO_LIMIT
        ]
        if metrics or pictures or videos:
            parts.append(
                {
                    "name": folder.name if deep else "training",
                    "rows": _rows(metrics),
                    "plot": _loss_curve(folder / "log.jsonl"),
                    "pictures": [_embed(p) for p in pictures],
                    "videos": videos,
                }
            )
    return parts


def _rows(table: dict, prefix: str = "") -> list[dict[str, str]]:
    """Flatten a nested table of figures into rows of label and value; lists are left out."""
    rows: list[dict[str, str]] = []
    for key, value in table.items():
        label = f"{prefix}{figure_label(key)}"
        if isinstance(value, dict):
            rows += _rows(value, f"{label}: ")
        elif not isinstance(value, list):
            rows.append({"label": label, "value": number(value)})
    return rows


def _table(path: Path) -> dict:
    return read_json_table(path, FormatError, AGAIN) if path.is_file() else {}


def _pictures_below(root: Path, limit: int) -> list[Picture]:
    """List pictures anywhere below a folder, captioned by their relative path."""
    paths = sorted(p for p in root.rglob("*") if p.suffix in (".jpg", ".png"))
    names = [_words(str(p.relative_to(root).with_suffix(""))).replace("/", ": ") for p in paths]
    return evenly(list(zip(paths, names, strict=True)), limit)


def _embed(picture: Picture) -> dict[str, object]:
    """Encode a picture as a JPEG data URI, at most PICTURE_WIDTH wide; caption only if damaged."""
    path, caption = picture
    try:
        image = read_srgb(path)
    except CaptureError as error:
        return {"uri": "", "caption": f"{caption}: cannot be shown, {error}", "wide": False}
    height, width = image.shape[:2]
    if width > PICTURE_WIDTH:
        image = resize_area(image, PICTURE_WIDTH, max(1, round(height * PICTURE_WIDTH / width)))
    uri = _address("image/jpeg", encode_jpeg(image, 85))
    return {"uri": uri, "caption": caption, "wide": width > 1.8 * height}


def _address(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def _words(name: str) -> str:
    return name.replace("_", " ")


def number(value: object) -> str:
    """Format a figure for readers; n/a if it was not measured, or names nothing."""
    if value is None or value == "":
        return "n/a"
    if not is_number(value):
        return str(value)
    if isinstance(value, int) or float(value).is_integer() and abs(value) < 1e6:
        return f"{int(value):,}"
    return f"{value:.3g}" if abs(value) < 100 else f"{value:,.0f}"


def _svg(figure: Figure) -> Markup:
    """Draw inline SVG with a fixed id salt, so that the same data give the same bytes."""
    with mpl.rc_context({"svg.hashsalt": "express50"}):
        out = io.StringIO()
        figure.savefig(out, format="svg", bbox_inches="tight", metadata={"Date": None})
    text = out.getvalue()
    return Markup(text[text.index("<svg") :])  # Matplotlib's output, which needs no escaping


def _metric_bars(figures: dict[str, dict[str, float]], columns: list[str]) -> Markup:
    """Draw one panel per metric: a bar per item, or of many items how many have which value."""
    varying = [c for c in columns if len({row.get(c) for row in figures.values()}) > 1][:PANELS]
    if not varying:
        return Markup("")
    figure = Figure(figsize=(2.9 * len(varying), 1.8))
    figure.subplots(1, len(varying))
    for axes, column in zip(figure.axes, varying, strict=True):
        values = [row[column] for row in figures.values() if column in row]
        axes.tick_params(labelsize=7)
        if len(values) <= BARS:
            axes.bar(range(len(values)), values, color=INK)
            axes.set_xticks([])
        else:  # bars narrower than a pixel, and megabytes of them
            axes.hist(values, bins=BINS, color=INK)
            axes.set_ylabel("items", fontsize=7)
        axes.set_title(figure_label(column), fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    return _svg(figure)


def _front_view(table: dict) -> dict | None:
    """Collect what ``express50 tune`` measured: a panel per result, and a row per point."""
    if not table:
        return None
    points, presets = table["front"], table["presets"]
    results = list(points[-1]["errors"])
    figure = Figure(figsize=(3.2 * len(results), 2.6))
    figure.subplots(1, len(results), squeeze=False)
    for axes, result in zip(figure.axes, results, strict=True):
        rows = [(p["seconds"] / 60, p["errors"][result]) for p in points]
        times = [time for time, _ in rows]
        axes.fill_between(
            times, [e["low"] for _, e in rows], [e["high"] for _, e in rows], color=INK, alpha=0.15,
            lw=0,
        )  # fmt: skip
        axes.plot(times, [e["value"] for _, e in rows], "o-", color=INK, lw=1.4, ms=3.5)
        for line, (name, point) in enumerate(presets.items()):
            place = point["seconds"] / 60, point["errors"][result]["value"]
            axes.plot(*place, "s", color="#b3541e", ms=4)
            # One line apart: presets may share a point in this panel.
            axes.annotate(name, place, (5, 5 + 9 * line), textcoords="offset points", fontsize=7)
        error = rows[-1][1]
        axes.set_title(f"{result}, {error['unit']}", fontsize=9)
        axes.set_xlabel("minutes", fontsize=8)
        axes.set_ylim(bottom=0)
        axes.tick_params(labelsize=7)
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    stated = [result for result in results if points[-1]["errors"][result]["stated"]]
    usual = presets["standard"]["settings"]
    cells = [
        [format_seconds(p["seconds"]), *(number(p["errors"][r]["value"]) for r in results),
         ", ".join(f"{n} {k}" for n, k in p["settings"].items() if k != usual[n]) or "standard"]
        for p in points
    ]  # fmt: skip
    heads = [f"{r}, {points[-1]['errors'][r]['unit']}" for r in results]
    return {"plot": _svg(figure), "heads": heads, "rows": cells, "stated": stated}


def _loss_curve(log: Path) -> Markup:
    """Plot the training loss from a JSONL log; empty without a log of at least two rows."""
    rows = []
    for line in read_text(log, FormatError).split("\n") if log.is_file() else ():
        with suppress(FormatError):  # a killed run leaves a truncated last line
            row = parse_json(line, str(log), FormatError)
            if isinstance(row, dict) and {"iteration", "loss"} <= row.keys():
                rows.append(row)
    if len(rows) < 2:
        return Markup("")
    figure = Figure(figsize=(9, 2.6))
    axes = figure.add_subplot()
    axes.plot([r["iteration"] for r in rows], [r["loss"] for r in rows], color=INK, lw=1.2)
    axes.set_xlabel("iteration")
    axes.set_ylabel("loss")
    axes.set_yscale("log")
    axes.spines[["top", "right"]].set_visible(False)
    return _svg(figure)
