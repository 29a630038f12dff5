"""Gather what the stages left behind: metrics, pictures, failures and timings.

Reads files by the dataset's layout alone, so that a stage needs no word here to be reported.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from express50.contract.layout import Dataset
from express50.errors import FormatError
from express50.files.text import read_json_table

_PICTURES_A_STAGE = 12
AGAIN = "run its stage again"


@dataclass(frozen=True)
class Picture:
    """A picture file and the words under it."""

    path: Path
    caption: str


@dataclass(frozen=True)
class StageReport:
    """What one stage left.

    Attributes:
        name: the stage.
        items: item ids that are published.
        metrics: item id to its metrics.
        dropped: (item, what, why) of parts that items left out.
        noted: (item, what, why) of parts that were kept but are doubtful: `weak`, `warnings`.
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
    dropped = _reasons(metrics, ("dropped",))
    noted = _reasons(metrics, ("weak", "warnings"))
    pictures = [
        Picture(path, f"{item}: {path.stem.replace('_', ' ')}")
        for item in metrics
        for path in sorted((root / item / "qc").glob("*.jpg"))
        + sorted((root / item / "qc").glob("*.png"))
    ]
    shown = spread(pictures, _PICTURES_A_STAGE)
    return StageReport(stage, list(metrics), metrics, dropped, noted, shown, len(pictures))


def _reasons(metrics: dict[str, dict], keys: tuple[str, ...]) -> list[tuple[str, str, str]]:
    """(item, what, why) of the rows under some keys of all items' metrics."""
    return [
        (item, str(row.get("what")), str(row.get("why")))
        for item, table in metrics.items()
        for key in keys
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
