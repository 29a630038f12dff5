"""A warm start of depth against a cold one: seconds and errors of the same items in one run."""

from __future__ import annotations

import multiprocessing
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.depth_score import score, summary
from express50.capture.frames import read_peaks
from express50.contract.config import build_config
from express50.contract.layout import Dataset
from express50.dataset.tracks import read_track
from express50.twin.truth import Truth
from pipelines.depth import STAGE
from pipelines.depth.config import DepthConfig
from pipelines.depth.products import used_part
from pipelines.depth.reconstruct import reconstruct
from pipelines.depth.stage import read_prior, read_views
from pipelines.depth.warm import source_of, start_from, track_path

LEVELS = (1, 2)
WAYS = ("cold", *(f"warm_{count}_levels" for count in LEVELS))


def warm_start(dataset: Path, truth: Path, items: list[str]) -> dict:
    """Figures of the items that can start from another one's surface, by way; by standard preset.

    Seconds hold what a warm start needs of its own, not the source, which is made anyway.
    """
    config = replace(build_config(STAGE, {}), warm_start=True)
    pairs = [(item, source_of(Dataset(dataset), item, config)) for item in items]
    tables = []
    for item, source in pairs:
        if source is not None:
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
                tables.append(pool.submit(measure, dataset, truth, item, source, config).result())
    if not tables:
        return {"n/a": "no two expressions of a subject are tracked"}
    found: dict = {"items": [item for item, source in pairs if source is not None]}
    for way in WAYS:
        found[way] = summary([table[way] for table in tables])
    cold = found["cold"]["seconds_per_frame"]
    return found | {
        f"{way}_saves": round(1 - found[way]["seconds_per_frame"] / cold, 3) for way in WAYS[1:]
    }


def measure(
    dataset_root: Path, truth_root: Path, item: str, source: str, config: DepthConfig
) -> dict[str, dict]:
    """Errors and cost of an item by every way, one after another in this process."""
    cv2.setNumThreads(1)
    dataset, truth = Dataset(dataset_root), Truth(truth_root)
    subject, expression = item.split("/")
    first = source.split("/")[1]
    peaks = read_peaks(dataset, subject)
    views, _, _ = read_views(dataset, subject, first, peaks[first], config)
    prior, _ = read_prior(dataset, subject, first, views, config)
    begun = reconstruct(views, config, prior)
    used, faces = used_part(begun)
    mesh = begun.vertices[used], faces.astype(np.int64)
    views, pictures, _ = read_views(dataset, subject, expression, peaks[expression], config)
    found = {}
    for way, levels in zip(WAYS, (0, *LEVELS), strict=True):
        start = time.process_time()
        if levels:
            track = read_track(track_path(dataset, subject))
            carried, _ = start_from(mesh, track, (first, expression), views)
            surface = reconstruct(views, replace(config, warm_levels=levels), None, carried)
        else:
            prior, _ = read_prior(dataset, subject, expression, views, config)
            surface = reconstruct(views, config, prior)
        seconds = time.process_time() - start
        row = score((surface.vertices, surface.faces), truth, subject, peaks[expression], pictures)
        gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        found[way] = row | {"s": seconds, "gib": gib}
    return found
