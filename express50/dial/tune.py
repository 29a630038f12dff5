"""Write the measured front of a dataset: error of the whole chain against time."""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

from express50.console import format_seconds, format_table
from express50.contract.config import PRESETS
from express50.dial.budget import Clock
from express50.dial.choice import Point, Workload, error_text, front, labels_of, point_of
from express50.dial.figures import dial_dir
from express50.dial.measuring import measured_figures, workload
from express50.dial.pilot import Chain, standard_of
from express50.files.atomic import write_bytes, write_json


def tune(chain: Chain) -> tuple[dict[str, Any], list[str]]:
    """Measure every setting on a few items; write ``dial/front.json`` and ``dial/front.csv``.

    Returns the table and lines for people.

    Raises:
        StageError: no footage can be measured.
    """
    measured = measured_figures(chain, Clock(None))
    load = replace(workload(chain, measured, False, {}), done=())
    points = front(load)
    presets = {preset: point_of(load, preset_settings(load, preset)) for preset in PRESETS}
    table = {
        "schema": "express50.front/1",
        "footage": asdict(load.footage),
        "workers": load.width,
        "front": [_row(load, point) for point in points],
        "presets": {name: _row(load, point) for name, point in presets.items()},
    }
    folder = dial_dir(chain.dataset)
    write_json(folder / "front.json", table)
    write_bytes(folder / "front.csv", _csv(points, presets).encode())
    shutil.rmtree(chain.dataset.pilot_dir, ignore_errors=True)
    return table, [*_lines(load, points, presets), f"wrote {folder}/front.json and front.csv"]


def _row(load: Workload, point: Point) -> dict[str, Any]:
    cores = point_of(replace(load, cores=True), point.settings).seconds
    return asdict(point) | {"core_seconds": cores}


def preset_settings(load: Workload, preset: str) -> dict[str, str]:
    """Return the settings of a preset; standard's where a stage lacks it or it was not tried."""
    found = {}
    for stage in load.stages:
        tried = labels_of(load, stage.name)
        found[stage.name] = preset if preset in tried else standard_of(dict.fromkeys(tried))
    return found


def _csv(points: list[Point], presets: Mapping[str, Point]) -> str:
    """Write a row per point: time, errors with intervals, settings."""
    out = io.StringIO()
    head = ["point", "seconds"]
    for name, error in points[-1].errors.items():
        head += [f"{name}_{error.unit}{end}" for end in ("", "_low", "_high")]
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*head, *points[-1].settings])
    for name, point in [*((str(k), p) for k, p in enumerate(points)), *presets.items()]:
        figures = [f for e in point.errors.values() for f in (e.value, e.low, e.high)]
        row = [name, f"{point.seconds:.1f}", *(f"{f:.5g}" for f in figures)]
        writer.writerow([*row, *point.settings.values()])
    return out.getvalue()


def _lines(load: Workload, points: list[Point], presets: Mapping[str, Point]) -> list[str]:
    """Write the front for people: settings are those that change from one point to the next."""
    usual = preset_settings(load, "standard")
    rows = []
    for point in points:
        same = [name for name, one in presets.items() if one.settings == point.settings]
        changed = ", ".join(
            f"{n} {label}" for n, label in point.settings.items() if label != usual[n]
        )
        errors = [error_text(name, error).partition(" ")[2] for name, error in point.errors.items()]
        rows.append(
            [format_seconds(point.seconds), *errors, "/".join(same) or changed or "standard"]
        )
    head = ["time", *points[-1].errors, "settings that differ from standard"]
    beaten = [
        name for name, one in presets.items() if one.settings not in [p.settings for p in points]
    ]
    words = f"not on the front, as another choice is quicker and no worse: {', '.join(beaten)}"
    return [*format_table(head, rows), *([words] if beaten else [])]
