"""Share what most benchmarks need: options, twin recordings, runs of stages, figures, documents."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import shutil
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from benchmarks.truth import Truth
from express50.capture.frames import FrameReader, read_recorded_plate
from express50.capture.index import read_index
from express50.contract.config import build_config
from express50.contract.layout import Dataset
from express50.contract.stage import Stage
from express50.files.calibration import read_cameras, write_cameras
from express50.geometry.cameras import Camera, pinhole
from express50.geometry.sampling import undistort_image, undistorted_mask
from express50.runner.executor import Pool
from express50.runner.runner import run_stage
from express50.twin import TwinConfig
from express50.twin.record import print_progress, record
from pipelines import ingest

TITLE = "# Speed against accuracy\n"
T = TypeVar("T")


def make_parser(name: str, doc: str | None) -> argparse.ArgumentParser:
    """Return the parser of ``python -m benchmarks.<name>``, described by the module's words."""
    return argparse.ArgumentParser(
        prog=f"python -m benchmarks.{name}",
        description=doc,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_twin_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that name a dataset of twin captures and its truth, both or neither."""
    parser.add_argument("--dataset", type=Path, help="a twin dataset (default: one is recorded)")
    parser.add_argument("--truth", type=Path, help="its truth")


def check_twin_options(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Stop unless both options of `add_twin_options` are given, or neither."""
    if (options.dataset is None) != (options.truth is None):
        parser.error("give both --dataset and --truth, or neither")


def recorded(config: TwinConfig, folder: Path, preset: str = "draft") -> tuple[Dataset, Truth]:
    """Return a twin recording, made where it is not there, and ingested with a preset."""
    record(config, folder, report=print_progress())
    dataset = Dataset(folder / "data")
    ingest.add_captures(dataset, sorted((folder / "captures").iterdir()))
    run_or_stop(ingest.STAGE, dataset, preset)
    return dataset, Truth(folder / "truth")


def named_or_recorded(
    options: argparse.Namespace, config: TwinConfig, folder: Path
) -> tuple[Dataset, Truth]:
    """Return what the options of `add_twin_options` name, or else a recording (`recorded`)."""
    if options.dataset is None:
        return recorded(config, folder)
    return Dataset(options.dataset), Truth(options.truth)


def run_or_stop(stage: Stage, dataset: Dataset, preset: str = "standard", **values: Any) -> None:
    """Run a stage in this process; stop the benchmark when an item fails."""
    config = build_config(stage, {**stage.presets.get(preset, {}), **values})
    summary = run_stage(stage, dataset, config, pool=Pool(0), progress=False)
    if not summary.ok:
        sys.exit("\n".join(summary.lines()))


def write_peaks(
    dataset: Dataset, subject: str, peaks: Mapping[str, int], annotator: str = "truth"
) -> None:
    """Publish peaks, the frame of each expression, as labels by the first camera."""
    cameras = read_index(dataset, subject).cameras
    camera = min(cameras)
    rows = {
        name: {
            "frame": frame,
            "camera": camera,
            "pts": cameras[camera].pts[frame],
            "dhash": cameras[camera].dhash[frame],
            "confidence": 1.0,
            "annotator": annotator,
        }
        for name, frame in peaks.items()
    }
    path = dataset.peaks_file(subject)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(rows))


def keep_cameras(capture: Path, kept: Sequence[str]) -> None:
    """Take all other cameras out of a capture with given calibration."""
    cameras = read_cameras(capture / "calibration.json")
    for name in set(cameras) - set(kept):
        shutil.rmtree(capture / "cameras" / name)
        (capture / "plates" / f"{name}.png").unlink(missing_ok=True)
    (capture / "calibration.json").unlink()
    write_cameras(capture / "calibration.json", {name: cameras[name] for name in kept})


def in_own_process(function: Callable[..., T], *arguments: object) -> T:
    """Call a function in a new process, so that its memory can be measured."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def true_pictures(
    dataset: Dataset, truth: Truth, subject: str, camera: Camera, frame: int
) -> dict[str, np.ndarray]:
    """Return undistorted frame and plate, pixels with footage and true alpha of a camera's frame.

    The true camera undistorts them, so that no calibration counts.
    """
    index = read_index(dataset, subject)
    if camera.id not in index.plates:
        sys.exit(f"{dataset.root}: {subject}/{camera.id} has no plate; name another --dataset")
    valid = cv2.erode(undistorted_mask(camera).astype(np.uint8), np.ones((3, 3))) > 0
    with closing(FrameReader(index, camera.id)) as reader:
        image = reader.read(frame)
    return {
        "frame": undistort_image(image, camera),
        "plate": undistort_image(read_recorded_plate(index, camera.id), camera),
        "valid": valid,
        "true": truth.render_alpha(subject, frame, pinhole(camera)) * valid,
    }


def rms(values: Iterable[Any]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(np.asarray([*values])))))


def means(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean of each figure over the rows that have it."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {n: float(np.mean([row[n] for row in rows if n in row])) for n in names}


def rounded(row: Mapping[str, object]) -> dict[str, object]:
    """Return the row, and rows in it, with floats to five significant digits."""

    def short(value: object) -> object:
        if isinstance(value, Mapping):
            return rounded(value)
        return float(f"{value:.5g}") if isinstance(value, float) else value

    return {key: short(value) for key, value in row.items()}


def replace_section(path: Path, heading: str, lines: list[str]) -> None:
    """Replace a second-level section of a document, or append it; other sections stay."""
    text = path.read_text(encoding="utf-8") if path.is_file() else TITLE
    front, *parts = text.split("\n## ")
    sections = dict(part.split("\n", 1) for part in parts)
    sections[heading] = "\n" + "\n".join(lines).strip() + "\n"
    parts = [front.rstrip() + "\n", *(f"## {name}\n{body}" for name, body in sections.items())]
    path.write_text("\n".join(parts), encoding="utf-8")
