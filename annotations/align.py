"""The align stage: suggest the peak of every expression, accept it where no person has spoken.

Item: a subject. A suggestion that is accepted without a person goes through the same label store
that an annotator writes to, under the name ``auto``; a person's label always stands above it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from annotations.store import (
    AUTOMATIC,
    Label,
    append_label,
    current_labels,
    human_digest,
    make_mark,
    read_labels,
)
from annotations.suggest import (
    CROP,
    ClipObservation,
    Suggestion,
    activity,
    align_crop,
    candidates,
    suggest_peak,
)
from express50.errors import StageError
from express50.expressions import Expression, load_script
from express50.frames import read_proxy
from express50.images import contact_sheet, write_image
from express50.index import Cue, Index, read_index
from express50.landmarks.detector import detect
from express50.landmarks.network import LandmarkNet, load_network
from express50.layout import Dataset
from express50.stage import Stage

NEUTRAL = "neutral"


@dataclass(frozen=True, kw_only=True)
class AlignConfig:
    """Settings of the align stage."""

    cameras: int = 3
    """How many cameras watch the face; those that see it best at rest are taken."""
    stride: int = 1
    """Look at every stride-th frame of a cue window, at least 1."""
    min_score: float = 0.3
    """A camera whose median face score at rest is lower does not watch, 0 to 1."""

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        if self.cameras < 1 or self.stride < 1:
            raise ValueError(f"cameras {self.cameras}, stride {self.stride}: expected at least 1")


def list_items(dataset: Dataset) -> list[str]:
    """Subjects."""
    return dataset.subjects()


def item_inputs(dataset: Dataset, item: str, config: AlignConfig) -> dict[str, Path | str]:
    """The subject's index and proxies, and what people have decided."""
    return {"ingest": dataset.item_dir("ingest", item), "labels": human_digest(dataset, item)}


def run_item(dataset: Dataset, item: str, config: AlignConfig, out: Path) -> dict:
    """Suggest, accept and write ``suggestions.json``, ``peaks.json`` and a contact sheet."""
    index = read_index(dataset, item)
    if not index.cues:
        raise StageError(f"{item}: cues.csv names no expression; add the script's timing")
    script = {e.id: e for e in load_script()}
    net = load_network()
    rest_cue = next((c for c in index.cues if c.expression_id == NEUTRAL), None)
    watchers = choose_cameras(dataset, index, net, rest_cue or index.cues[0], config)
    rests = observe(dataset, index, net, watchers, _rest_frames(index, rest_cue), None)
    suggestions: dict[str, Suggestion] = {}
    dropped = []
    for cue in index.cues:
        frames = np.arange(cue.start_frame, min(cue.end_frame, index.frames - 1) + 1, config.stride)
        if frames.size == 0:
            dropped.append({"what": cue.expression_id, "why": "its cue lies beyond the footage"})
            continue
        suggestions[cue.expression_id] = suggest_in_window(
            dataset, index, net, watchers, rests, frames, script.get(cue.expression_id), cue
        )
    labels = accept(dataset, index, suggestions, watchers[0])
    peaks = {e: _peak_row(label) for e, label in labels.items() if label.action == "mark"}
    dropped += [
        {"what": e, "why": f"flagged by {label.annotator}: {label.reason or 'no reason given'}"}
        for e, label in labels.items()
        if label.action == "flag"
    ]
    _write_json(out / "peaks.json", peaks)
    starts = {cue.expression_id: cue.start_frame for cue in index.cues}
    rows = {e: _suggestion_row(s, starts[e], watchers[0]) for e, s in suggestions.items()}
    _write_json(out / "suggestions.json", rows)
    _write_sheet(dataset, index, watchers[0], peaks, out)
    return {
        "expressions": len(index.cues),
        "peaks": len(peaks),
        "by_person": sum(label.annotator != AUTOMATIC for label in labels.values()),
        "confidence_median": float(np.median([s.confidence for s in suggestions.values()])),
        "watching_cameras": watchers,
        "dropped": dropped,
    }


def _rest_frames(index: Index, cue: Cue | None) -> np.ndarray:
    """Frames at rest: the neutral clip, or else the first frame of every window."""
    if cue is not None:
        return np.arange(cue.start_frame, min(cue.end_frame, index.frames - 1) + 1)
    return np.array([c.start_frame for c in index.cues if c.start_frame < index.frames])


def choose_cameras(
    dataset: Dataset, index: Index, net: LandmarkNet, cue: Cue, config: AlignConfig
) -> list[str]:
    """The cameras that see the face best in the middle of a cue, best first.

    Raises:
        StageError: no camera sees a face.
    """
    middle = min((cue.start_frame + cue.end_frame) // 2, index.frames - 1)
    scores = {
        camera: detect(net, read_proxy(dataset, index.subject, camera, middle)).score
        for camera in index.cameras
    }
    seeing = [
        c for c in sorted(scores, key=lambda c: (-scores[c], c)) if scores[c] >= config.min_score
    ]
    if not seeing:
        best = max(scores, key=lambda c: scores[c])
        raise StageError(
            f"{index.subject}: no camera sees a face at frame {middle} (best {best} with score"
            f" {scores[best]:.2f}, expected {config.min_score}); label it with 'express50 annotate"
            " mark' or lower align.min_score"
        )
    return seeing[: config.cameras]


def observe(
    dataset: Dataset,
    index: Index,
    net: LandmarkNet,
    cameras: list[str],
    frames: np.ndarray,
    rests: list[ClipObservation] | None,
) -> list[ClipObservation]:
    """Landmarks, scores and aligned faces of some frames, one observation a camera."""
    out = []
    for number, camera in enumerate(cameras):
        images = [read_proxy(dataset, index.subject, camera, int(f)) for f in frames]
        found = [detect(net, image) for image in images]
        points = np.stack([d.points for d in found])
        neutral = np.median(points if rests is None else rests[number].points, axis=0)
        crops = np.stack(
            [align_crop(i, p, neutral) for i, p in zip(images, points, strict=True)]
        ).reshape(-1, CROP, CROP)
        out.append(ClipObservation(points, np.array([d.score for d in found]), crops))
    return out


def suggest_in_window(
    dataset: Dataset,
    index: Index,
    net: LandmarkNet,
    cameras: list[str],
    rests: list[ClipObservation],
    frames: np.ndarray,
    expression: Expression | None,
    cue: Cue,
) -> Suggestion:
    """The suggestion for one cue window, sampled at ``frames``."""
    clips = observe(dataset, index, net, cameras, frames, rests)
    curve = activity(clips, rests, expression)
    found = suggest_peak(curve, 0, at_rest=cue.expression_id == NEUTRAL)
    whole = np.interp(np.arange(frames[0], frames[-1] + 1), frames, found.activity)
    return Suggestion(int(frames[found.frame]), found.confidence, whole)


def accept(
    dataset: Dataset, index: Index, suggestions: dict[str, Suggestion], camera: str
) -> dict[str, Label]:
    """Append an automatic mark for each suggestion that is news; return the labels in force.

    A rerun of the same suggestions appends nothing.
    """
    labels = read_labels(dataset, index.subject)
    automatic = current_labels(label for label in labels if label.annotator == AUTOMATIC)
    for expression, suggestion in suggestions.items():
        known = automatic.get(expression)
        if known is not None and (known.frame, known.camera) == (suggestion.frame, camera):
            continue
        mark = make_mark(
            index, expression, suggestion.frame, camera, AUTOMATIC, suggestion.frame,
            round(suggestion.confidence, 4),
        )  # fmt: skip
        append_label(dataset, mark)
        labels.append(mark)
    return {e: label for e, label in current_labels(labels).items() if e in suggestions}


def _peak_row(label: Label) -> dict[str, object]:
    return {
        "frame": label.frame,
        "camera": label.camera,
        "pts": label.pts,
        "dhash": label.dhash,
        "confidence": label.confidence,
        "annotator": label.annotator,
    }


def _suggestion_row(suggestion: Suggestion, start: int, camera: str) -> dict[str, object]:
    return {
        "frame": suggestion.frame,
        "confidence": round(suggestion.confidence, 4),
        "start": start,
        "activity": [round(float(a), 3) for a in suggestion.activity],
        "candidates": candidates(suggestion, start),
        "kind": "peak",
        "camera": camera,
    }


def _write_json(path: Path, table: dict) -> None:
    path.write_text(json.dumps(table, indent=1, sort_keys=True) + "\n")


def _write_sheet(dataset: Dataset, index: Index, camera: str, peaks: dict, out: Path) -> None:
    """QC: the chosen frame of every expression, between its window's first and last frame."""
    rows, names = [], []
    for cue in index.cues:
        if cue.expression_id not in peaks:
            continue
        last = min(cue.end_frame, index.frames - 1)
        frames = [cue.start_frame, peaks[cue.expression_id]["frame"], last]
        rows.append([read_proxy(dataset, index.subject, camera, int(f)) for f in frames])
        names.append(f"{cue.expression_id}: first, peak {frames[1]}, last")
    (out / "qc").mkdir()
    write_image(out / "qc" / "peaks.jpg", contact_sheet(rows, names), quality=85)


STAGE = Stage(
    name="align",
    version=2,
    config=AlignConfig,
    presets={
        "draft": {"cameras": 1, "stride": 2},
        "standard": {},
        "reference": {"cameras": 6},
    },
    items=list_items,
    inputs=item_inputs,
    run=run_item,
)
