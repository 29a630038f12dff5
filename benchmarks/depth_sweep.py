"""Vary one setting of depth at a time around the standard preset: seconds and errors."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.common import in_own_process, replace_section
from benchmarks.depth_score import score
from benchmarks.truth import Truth
from express50.capture.index import read_peaks
from express50.contract.config import build_config
from express50.contract.layout import Dataset
from express50.files.text import markdown_table
from express50.geometry.sampling import evenly
from pipelines.depth import STAGE
from pipelines.depth.reconstruct import reconstruct
from pipelines.depth.stage import read_tracked, read_views

SECTION = "Settings of depth"
AXES: dict[str, tuple[str, tuple]] = {
    "views": ("views", (6, 12, 24)),
    "pixels": ("image_side", (256, 512, 1024)),
    "voxel": ("voxel_mm", (4.0, 2.4, 1.6, 1.0)),
}


def sweep(options: argparse.Namespace, item: str) -> dict:
    """Measure every value of the chosen axes on one item; writes the table where asked to."""
    rows = []
    for axis in options.axes:
        for value in AXES[axis][1]:
            source = options.dataset, options.truth, item
            rows.append(in_own_process(measure, *source, axis, value))
            print(rows[-1], file=sys.stderr, flush=True)
    if options.doc is not None:
        replace_section(options.doc, SECTION, as_markdown(rows, item))
    return {"benchmark": "depth", "sweep": rows, "item": item}


def measure(dataset_root: Path, truth_root: Path, item: str, axis: str, value: float) -> dict:
    """Measure one value: its cost, and errors in every camera of the rig."""
    cv2.setNumThreads(1)
    dataset, truth = Dataset(dataset_root), Truth(truth_root)
    subject, expression = item.split("/")
    frame = read_peaks(dataset, subject)[expression]
    config = build_config(STAGE, {})
    if axis != "views":
        config = replace(config, **{AXES[axis][0]: value})
    views, pictures, _ = read_views(dataset, item, config.image_side)
    if axis == "views":
        views = evenly(views, int(value))
    start = time.process_time()
    views, solid, _ = read_tracked(dataset, item, views)
    surface = reconstruct(views, solid, config.voxel_mm, config.voxel_px, config.noise)
    seconds = time.process_time() - start
    found = score((surface.vertices, surface.faces), truth, subject, frame, pictures)
    median, tail = np.percentile(found["errors"], [50, 95])
    return {
        "setting": AXES[axis][0],
        "value": value,
        "views": len(views),
        "pixels": max(views[0].camera.width, views[0].camera.height),
        "voxel_mm": round(surface.grid.voxel * 1e3, 2),
        "seconds": round(seconds, 1),
        "abs_error_mm_median": round(float(median), 3),
        "abs_error_mm_p95": round(float(tail), 2),
        "skin_error_mm_median": round(float(np.median(found["skin"])), 3),
        "coverage": round(found["covered"], 4),
    }


def as_markdown(rows: list[dict], item: str) -> list[str]:
    """Format the section of the document."""
    lines = [
        f"Made by `python -m benchmarks.depth --sweep` on {item} of a synthetic capture: one"
        " setting at a time differs from `standard`. The columns views, pixels (of the longest"
        " side) and voxel show what was used: the footage may have fewer views, or be too coarse"
        " for smaller voxels. Seconds are of one core; errors are over all cameras of the rig,"
        " including those that the setting leaves out.",
        "",
    ]
    head = ("setting", "value", "views", "pixels", "voxel mm", "seconds", "median mm", "95 % mm",
            "skin mm")  # fmt: skip
    keys = ("setting", "value", "views", "pixels", "voxel_mm", "seconds", "abs_error_mm_median",
            "abs_error_mm_p95", "skin_error_mm_median")  # fmt: skip
    return lines + markdown_table(head, [[row[key] for key in keys] for row in rows])
