"""Turn what was collected into one HTML page with every picture inside it."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import jinja2

from express50.contract.extensions import stages
from express50.contract.layout import Dataset
from express50.dataset.report import plots
from express50.errors import FormatError
from express50.files.images import encode_jpeg, read_image, resize_area
from express50.files.text import read_json_table
from express50.runner.ledger import Ledger, Receipt

PICTURE_WIDTH = 900  # pixels of an embedded picture: a page of forty stays below ten megabytes
_ROWS = 12
_COLUMNS = 8
_VIDEO_LIMIT = 8_000_000


@dataclass(frozen=True)
class Embedded:
    """A picture or video as a data address, empty where it cannot be read."""

    uri: str
    caption: str
    wide: bool = False


def embed(picture: Picture) -> Embedded:
    """The picture, at most PICTURE_WIDTH wide, as a JPEG data address; words alone if damaged."""
    try:
        image = read_image(picture.path)
    except FormatError as error:
        return Embedded("", f"{picture.caption}: cannot be shown, {error}")
    height, width = image.shape[:2]
    if width > PICTURE_WIDTH:
        image = resize_area(image, PICTURE_WIDTH, max(1, round(height * PICTURE_WIDTH / width)))
    code = base64.b64encode(encode_jpeg(image[..., :3] if image.ndim == 3 else image, 85)).decode()
    return Embedded(f"data:image/jpeg;base64,{code}", picture.caption, width > 1.8 * height)


def embed_videos(root: Path) -> list[Embedded]:
    """Videos below a folder that are small enough to carry along."""
    paths = sorted(root.rglob("*.mp4")) if root.is_dir() else []
    return [
        Embedded(
            "data:video/mp4;base64," + base64.b64encode(p.read_bytes()).decode(),
            p.stem.replace("_", " "),
        )
        for p in paths
        if p.stat().st_size <= _VIDEO_LIMIT
    ]


def number(value: object) -> str:
    """Format a figure for people; n/a if it was not measured."""
    if value is None:
        return "n/a"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    if isinstance(value, int) or float(value).is_integer() and abs(value) < 1e6:
        return f"{int(value):,}"
    return f"{value:.3g}" if abs(value) < 100 else f"{value:,.0f}"


def _rows(table: dict, prefix: str = "") -> list[dict[str, str]]:
    """Flat label and value rows of a nested table of figures; long lists are left out."""
    rows: list[dict[str, str]] = []
    for key, value in table.items():
        label = f"{prefix}{key}"
        if isinstance(value, dict):
            rows += _rows(value, f"{label}.")
        elif not isinstance(value, list):
            rows.append({"label": label.replace("_", " "), "value": number(value)})
    return rows


def _receipts(dataset: Dataset) -> dict[str, list[Receipt]]:
    """Read the receipts of all stages; none where no stage was run."""
    if not dataset.ledger.is_file():
        return {name: [] for name in stages()}
    with Ledger(dataset.ledger, read_only=True) as ledger:
        return {name: list(ledger.read(name).values()) for name in stages()}


def _stage_view(report: StageReport, receipts: list[Receipt]) -> dict:
    """Collect what the template needs of one stage."""
    figures = scalar_metrics(report)
    columns = list(dict.fromkeys(key for row in figures.values() for key in row))[:_COLUMNS]
    shown = list(figures.items())[:_ROWS]
    return {
        "name": report.name,
        "purpose": stages()[report.name].purpose,
        "item_count": len(report.items),
        "failed": [(r.item, r.reason) for r in receipts if r.status == "failed"],
        "dropped": report.dropped,
        "noted": report.noted,
        "seconds": number(round(sum(r.seconds for r in receipts), 1)),
        "columns": columns,
        "rows": [
            {"item": item, "cells": [number(row.get(c)) for c in columns]} for item, row in shown
        ],
        "more_rows": len(figures) - len(shown),
        "plot": plots.metric_bars(figures, columns) if len(figures) > 1 else "",
        "pictures": [embed(p) for p in report.pictures],
        "picture_count": report.picture_count,
    }


def _grmm_view(root: Path) -> list[dict]:
    """One part a folder below ``grmm``: train, fit, render."""
    folders = [p for p in sorted(root.iterdir()) if p.is_dir()] if root.is_dir() else []
    parts = []
    for folder in [root, *folders] if root.is_dir() else []:
        metrics = read_json(folder / "metrics.json")
        deep = folder != root
        found = pictures_below(folder, 8) if deep else []
        videos = embed_videos(folder) if deep else []
        if metrics or found or videos:
            parts.append(
                {
                    "name": folder.name if deep else "training",
                    "rows": _rows(metrics),
                    "plot": plots.loss_curve(folder / "log.jsonl"),
                    "pictures": [embed(p) for p in found],
                    "videos": videos,
                }
            )
    return parts


def _cards(dataset: Dataset, reports: Iterable[StageReport], summary: dict) -> list[dict[str, str]]:
    peaks = {s: read_json(dataset.peaks_file(s)) for s in dataset.subjects()}
    expressions = {e for table in peaks.values() for e in table}
    cards = [
        {"label": "subjects", "value": number(len(peaks))},
        {"label": "expressions", "value": number(len(expressions))},
        {"label": "peak labels", "value": number(sum(map(len, peaks.values())))},
        {"label": "parts dropped", "value": number(sum(len(r.dropped) for r in reports))},
    ]
    seconds = summary.get("seconds")
    if isinstance(seconds, dict):
        cards.append({"label": "minutes in all", "value": f"{sum(seconds.values()) / 60:.1f}"})
    for key in ("train.psnr_heldout_view_db", "fit.psnr_db", "peak_memory_gib"):
        if summary.get(key) is not None:
            cards.append({"label": key.replace("_", " "), "value": number(summary[key])})
    return cards


def render_page(dataset: Dataset, title: str | None = None) -> str:
    """The whole page as text.

    Beside the stages' folders it reads, where they exist: ``summary.json`` (figures of the run),
    ``accuracy/`` (errors against truth, made by the benchmarks) and ``grmm/``.
    """
    receipts = _receipts(dataset)
    reports = [collect_stage(dataset, name) for name in stages()]
    # A stage all of whose items failed has published nothing, and is what people look for.
    reports = [r for r in reports if r.items or any(x.status == "failed" for x in receipts[r.name])]
    summary = read_json(dataset.root / "summary.json")
    accuracy_dir = dataset.root / "accuracy"
    measured = read_json(accuracy_dir / "accuracy.json")
    accuracy = None
    if measured:
        pictures = spread(pictures_below(accuracy_dir), 12)
        accuracy = {"rows": _rows(measured), "pictures": [embed(p) for p in pictures]}
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("express50.dataset.report", "."), autoescape=True
    )
    seconds = summary.get("seconds", {})
    return environment.get_template("template.html").render(
        title=title or f"Dataset {dataset.root.resolve().name}",
        subtitle=", ".join(dataset.subjects()),
        cards=_cards(dataset, reports, summary),
        stages=[_stage_view(r, receipts[r.name]) for r in reports],
        accuracy=accuracy,
        grmm=_grmm_view(dataset.root / "grmm"),
        timing_plot=plots.timing_bars(seconds) if seconds else "",
    )


_PICTURES_A_STAGE = 12
AGAIN = "run its stage again"


@dataclass(frozen=True)
class Picture:
    """A picture file and the words under it."""

    path: Path
    caption: str


@dataclass(frozen=True)
class StageReport:
    """Holds what one stage left.

    Attributes:
        name: the stage.
        items: item ids that are published.
        metrics: item id to its metrics.
        dropped: (item, what, why) of parts that items left out.
        noted: (item, what, why) of parts that were kept but are doubtful.
        pictures: QC pictures, evenly chosen over the items.
        picture_count: how many there are in all.
    """

    name: str
    items: list[str]
    metrics: dict[str, dict]
    dropped: list[tuple[str, str, str]]
    noted: list[tuple[str, str, str]]
    pictures: list[Picture]
    picture_count: int


def collect_stage(dataset: Dataset, stage: str) -> StageReport:
    """Read every published item of a stage."""
    root = dataset.stage_dir(stage)
    paths = sorted(root.rglob("metrics.json")) if root.is_dir() else []
    metrics = {
        str(p.parent.relative_to(root)): read_json_table(p, FormatError, AGAIN) for p in paths
    }
    dropped = _reasons(metrics, "dropped")
    noted = _reasons(metrics, "warnings")
    pictures = [
        Picture(path, f"{item}: {path.stem.replace('_', ' ')}")
        for item in metrics
        for path in sorted((root / item / "qc").glob("*.jpg"))
        + sorted((root / item / "qc").glob("*.png"))
    ]
    shown = spread(pictures, _PICTURES_A_STAGE)
    return StageReport(stage, list(metrics), metrics, dropped, noted, shown, len(pictures))


def _reasons(metrics: dict[str, dict], key: str) -> list[tuple[str, str, str]]:
    """List (item, what, why) of the rows under a key of all items' metrics."""
    return [
        (item, str(row.get("what")), str(row.get("why")))
        for item, table in metrics.items()
        for row in table.get(key, [])
        if isinstance(row, dict)
    ]


def spread(pictures: list[Picture], count: int) -> list[Picture]:
    """At most ``count`` of the pictures, evenly chosen."""
    if len(pictures) <= count:
        return pictures
    return [pictures[round(i * (len(pictures) - 1) / (count - 1))] for i in range(count)]


def scalar_metrics(report: StageReport) -> dict[str, dict[str, float]]:
    """Item to its metrics that are plain numbers, for tables and plots."""
    return {
        item: {
            key: float(value)
            for key, value in table.items()
            if isinstance(value, int | float) and not isinstance(value, bool)
        }
        for item, table in report.metrics.items()
    }


def read_json(path: Path) -> dict:
    """A JSON table, empty where the file is absent."""
    return read_json_table(path, FormatError, AGAIN) if path.is_file() else {}


def pictures_below(root: Path, limit: int = 24) -> list[Picture]:
    """Pictures anywhere below a folder, captioned by their relative path."""
    paths = (
        sorted(p for p in root.rglob("*") if p.suffix in (".jpg", ".png")) if root.is_dir() else []
    )
    found = [
        Picture(p, str(p.relative_to(root).with_suffix("")).replace("_", " ").replace("/", ": "))
        for p in paths
    ]
    return spread(found, limit)
