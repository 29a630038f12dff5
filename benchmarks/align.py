"""Measure how well peaks and matches are suggested, and what labelling them in the UI costs.

``python -m benchmarks.align [--dataset DIR --truth DIR]``; without a dataset one is recorded with
the digital twin: other subjects than the demo's, the whole script, every clip with its own timing
and strength. Peaks are judged with everybody on their own, matches with the first subject labelled
as the reference: at its true peaks, then at frames before or after them. A simulated annotator then
accepts right suggestions and corrects wrong ones in the app, and steps through 24 cameras of 3840 x
2160 footage are timed. The baseline takes the frame whose landmarks are furthest from neutral. The
last line printed is one JSON object.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from annotations import align, observe
from annotations.labels import append_label, make_mark
from annotations.observe.stage import STABLE, cue_frames, read_observations, similarity_2d
from annotations.suggestions import read_suggestions, reference_subject
from benchmarks.common import (
    add_twin_options,
    check_twin_options,
    make_parser,
    recorded,
    replace_section,
    run_or_stop,
)
from benchmarks.replay import measure_steps, replay
from benchmarks.truth import Truth
from express50.capture.expressions import NEUTRAL
from express50.capture.frames import read_proxy
from express50.capture.index import Cue, read_index
from express50.contract.config import PRESETS
from express50.contract.layout import Dataset
from express50.files.images import write_image
from express50.files.text import markdown_table
from express50.geometry.transforms import transform_points
from express50.twin import TwinConfig
from pipelines import ingest
from pipelines.ingest import add_captures

THRESHOLDS = (0.0, 0.3, 0.5, 0.7, 0.9, 0.95)
OFF_APEX = (0.45, 0.85)  # strengths at which canonical frames off the apex are taken
SAME_STRENGTH = 0.1  # of the peak: frames that differ by less match equally well to the eye
SOURCE = (2160, 3840)


def main(arguments: list[str] | None = None) -> int:
    """Measure, print a table and the JSON line."""
    parser = make_parser("align", __doc__)
    add_twin_options(parser)
    parser.add_argument("--subjects", type=int, default=6)
    parser.add_argument("--frames", type=int, default=12, help="frames per expression")
    parser.add_argument("--preset", default="standard", choices=PRESETS)
    parser.add_argument("--doc", type=Path, help="write the acceptance table into this document")
    options = parser.parse_args(arguments)
    check_twin_options(parser, options)
    with tempfile.TemporaryDirectory() as scratch:
        if options.dataset is None:
            config = twin_config(options.subjects, options.frames)
            dataset, truth = recorded(config, Path(scratch) / "twin", "standard")
        else:  # labels are written: not into somebody's dataset
            dataset = Dataset(Path(scratch) / "dataset")
            shutil.copytree(options.dataset / "ingest", dataset.root / "ingest")
            shutil.copy(options.dataset / "captures.json", dataset.captures_file)
            truth = Truth(options.truth)
        figures = measure(dataset, truth, options.preset)
        steps = measure_steps(record_4k(Path(scratch), dataset), 200)
    figures["seconds_per_frame_step_p95"] = round(float(np.percentile(steps, 95)), 4)
    if options.doc is not None:
        replace_section(options.doc, "Accepting suggestions", as_markdown(figures))
    print(json.dumps(figures))
    return 0


def measure(dataset: Dataset, truth: Truth, preset: str) -> dict:
    """Return all figures but the steps' time."""
    subjects = dataset.subjects()
    began = time.perf_counter()
    run_or_stop(observe.STAGE, dataset, preset)
    run_or_stop(align.STAGE, dataset, preset, match=False)
    seconds = time.perf_counter() - began
    peaks = peak_errors(dataset, truth)
    farthest = [
        abs(frame - truth.peaks(subject)[expression])
        for subject in subjects
        for expression, frame in farthest_frames(dataset, subject)
    ]
    off_apex, _ = match_errors(dataset, truth, preset, off_apex=True)
    matches, sure = match_errors(dataset, truth, preset, off_apex=False)
    truths = {(s, e): f for s in subjects for e, f in truth.peaks(s).items() if e != NEUTRAL}
    effort = replay(dataset, truths, tolerance=1).summary()
    return {
        "subjects": len(subjects),
        "labels": len(peaks),
        "peak_within_1_frame": within(peaks, 1),
        "peak_within_2_frames": within(peaks, 2),
        "baseline_peak_within_1_frame": within(farthest, 1),
        "match_within_2_frames": within(matches, 2),
        "match_within_1_frame": within(matches, 1),
        "match_off_apex_within_2_frames": within(off_apex, 2),
        "keystrokes_per_label_median": effort["keystrokes_per_label_median"],
        "keystrokes_per_label_mean": round(effort["keystrokes_per_label_mean"], 4),
        "suggest_seconds_per_subject": round(seconds / len(subjects), 3),
        "frames_per_subject": read_index(dataset, subjects[0]).frames,
        "acceptance": acceptance(matches, sure),
    }


def within(errors: list[int], frames: int) -> float:
    """Return the share of errors of at most so many frames."""
    return round(float(np.mean(np.array(errors) <= frames)), 4)


def peak_errors(dataset: Dataset, truth: Truth) -> list[int]:
    """Count the frames off the true peak of every suggestion but the neutral one's."""
    return [
        abs(found.frame - truth.peaks(subject)[expression])
        for subject in dataset.subjects()
        for expression, found in read_suggestions(dataset, subject).items()
        if expression != NEUTRAL
    ]


def match_errors(
    dataset: Dataset, truth: Truth, preset: str, off_apex: bool
) -> tuple[list[int], list[float]]:
    """Count the frames off the best match, and list confidences, of all but the reference.

    The reference is labelled first, at its true peaks or at random frames off them.
    """
    reference = reference_subject(dataset)
    levels = label_reference(dataset, truth, reference, off_apex)
    run_or_stop(align.STAGE, dataset, preset)
    errors, confidences = [], []
    for subject in dataset.subjects():
        for expression, found in read_suggestions(dataset, subject).items():
            if subject != reference and expression != NEUTRAL:
                level = levels[expression]
                errors.append(match_error(dataset, truth, subject, expression, level, found.frame))
                confidences.append(found.confidence)
    return errors, confidences


def label_reference(
    dataset: Dataset, truth: Truth, reference: str, off_apex: bool
) -> dict[str, float]:
    """Mark the reference's canonical frames; how far each expression is played in its frame."""
    index, rng, levels = read_index(dataset, reference), np.random.default_rng(0), {}
    camera = next(iter(index.cameras))
    for cue in index.cues:
        shares = shares_of(truth, reference, cue)
        usable = np.flatnonzero((shares > OFF_APEX[0]) & (shares < OFF_APEX[1]))
        frame = truth.peaks(reference)[cue.expression_id]
        if off_apex and usable.size:
            frame = cue.start_frame + int(rng.choice(usable))
        levels[cue.expression_id] = float(shares[frame - cue.start_frame])
        append_label(dataset, make_mark(index, cue.expression_id, frame, camera, "benchmark"))
    return levels


def match_error(
    dataset: Dataset, truth: Truth, subject: str, expression: str, level: float, frame: int
) -> int:
    """Count frames to the nearest at which the subject goes as far as the reference did."""
    cue = next(c for c in read_index(dataset, subject).cues if c.expression_id == expression)
    away = np.abs(shares_of(truth, subject, cue) - level)
    same = cue.start_frame + np.flatnonzero(away <= away.min() + SAME_STRENGTH)
    return int(np.abs(same - frame).min())


def shares_of(truth: Truth, subject: str, cue: Cue) -> np.ndarray:
    """Return the expression's strength in each frame of its window, as a share of its peak."""
    frames = range(cue.start_frame, cue.end_frame + 1)
    strengths = np.array([float(truth.parameters(subject, f)["strength"]) for f in frames])
    return strengths / strengths.max()


def farthest_frames(dataset: Dataset, subject: str) -> Iterator[tuple[str, int]]:
    """Find the baseline's frames: landmarks furthest from neutral, head motion removed."""
    seen, index = read_observations(dataset, subject), read_index(dataset, subject)
    points = seen.points[0].astype(np.float64)
    windows = {
        c.expression_id: np.searchsorted(seen.frames, cue_frames(index, c)) for c in index.cues
    }
    neutral = np.median(points[windows[NEUTRAL]], axis=0)
    for expression, rows in windows.items():
        moves = [similarity_2d(p[STABLE], neutral[STABLE]) for p in points[rows]]
        moved = [transform_points(A, p) - neutral for p, A in zip(points[rows], moves, strict=True)]
        if expression != NEUTRAL:
            yield expression, int(seen.frames[rows[np.argmax([(m**2).sum() for m in moved])]])


def acceptance(errors: list[int], confidences: list[float]) -> list[dict[str, float | None]]:
    """Measure what accepting sure suggestions leaves to people, and how far off these are."""
    off, sure = np.array(errors), np.array(confidences)
    out: list[dict[str, float | None]] = []
    for threshold in THRESHOLDS:
        taken = off[sure >= threshold]
        out.append(
            {
                "accept": threshold,
                "by_hand": round(1.0 - taken.size / off.size, 4),
                "error_frames_mean": round(float(taken.mean()), 4) if taken.size else None,
                "within_1_frame": round(float((taken <= 1).mean()), 4) if taken.size else None,
            }
        )
    return out


def as_markdown(figures: dict) -> list[str]:
    """Return the acceptance table as a section of docs/TRADEOFFS.md."""
    lines = [
        f"Made by `python -m benchmarks.align --doc docs/TRADEOFFS.md` on {figures['subjects']}"
        f" synthetic subjects, {figures['labels']} clips; the reference's clips are not counted."
        " Suggestions whose confidence reaches `align.accept` are accepted automatically.",
        "",
    ]
    head = ["accept", "labels by hand", "mean error of the others, frames", "within one frame"]
    rows = []
    for row in figures["acceptance"]:
        error, near = row["error_frames_mean"], row["within_1_frame"]
        shown = ["n/a", "n/a"] if error is None else [f"{error:.3f}", f"{100 * near:.1f} %"]
        rows.append([f"{row['accept']:g}", f"{100 * row['by_hand']:.1f} %", *shown])
    return lines + markdown_table(head, rows)


def twin_config(subjects: int, frames: int) -> TwinConfig:
    """Return subjects that nothing was developed on."""
    return TwinConfig(
        subjects=subjects, first_subject=61, cameras=1, width=256, height=256,
        frames_per_expression=frames, board_frames=0, give_calibration=True, footage="jpg",
        plates=False, seed=17,
    )  # fmt: skip


def record_4k(scratch: Path, dataset: Dataset) -> Dataset:
    """Ingest a capture of 24 cameras at 3840 x 2160: frames of the dataset, enlarged."""
    cameras, frames = 24, 12  # frames per expression
    capture, subject = scratch / "big", dataset.subjects()[0]
    camera = next(iter(read_index(dataset, subject).cameras))
    for number in range(cameras):
        folder = capture / "cameras" / f"cam{number:02d}" / "frames"
        folder.mkdir(parents=True)
        for frame in range(2 * frames):
            path = folder / f"{frame:06d}.jpg"
            if number:
                path.hardlink_to(capture / "cameras" / "cam00" / "frames" / path.name)
                continue
            image = read_proxy(dataset, subject, camera, frame)
            square = cv2.resize(image, (SOURCE[0], SOURCE[0]), interpolation=cv2.INTER_CUBIC)
            canvas = np.zeros((*SOURCE, 3), np.uint8)
            left = (SOURCE[1] - SOURCE[0]) // 2
            canvas[:, left : left + SOURCE[0]] = square
            write_image(path, canvas, quality=90)
    (capture / "capture.toml").write_text('subject = "BIG"\nfps = 24.0\n')
    cues = f"neutral,0,{frames - 1}\nsmile,{frames},{2 * frames - 1}\n"
    (capture / "cues.csv").write_text("expression_id,start_frame,end_frame\n" + cues)
    big = Dataset(scratch / "big_dataset")
    add_captures(big, [capture])
    run_or_stop(ingest.STAGE, big, "standard")
    return big


if __name__ == "__main__":
    sys.exit(main())
