"""The align stage: for every expression the frame that matches the reference's canonical frame.

Item: a subject. What the observe stage saw is compared with the reference identity's labels or
peaks. A suggestion that is sure enough is accepted without a person, through the same label store
that an annotator writes to, under the name ``auto``; a person's label always stands above it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from annotations.config import AlignConfig
from annotations.labels import AUTOMATIC, Label, make_mark, make_undo
from annotations.match import Reference, Watched, suggest_all, watch
from annotations.observe import observations_path, read_observations
from annotations.store import append_label, current_labels, human_digest, read_labels
from annotations.suggest import Suggestion
from annotations.suggestions import reference_subject
from express50.capture.expressions import load_script
from express50.capture.frames import read_proxy
from express50.capture.index import Index, read_index
from express50.contract.layout import Dataset
from express50.errors import StageError
from express50.files.images import contact_sheet, write_image


def item_inputs(dataset: Dataset, item: str, config: AlignConfig) -> dict[str, Path | str]:
    """The subject's index and observations, the reference's, and what people said of both."""
    inputs: dict[str, Path | str] = {
        "index": dataset.item_dir("ingest", item) / "index.json",
        "observe": _or_absent(observations_path(dataset, item)),
        "labels": human_digest(dataset, item),
    }
    if config.match and (other := reference_subject(dataset)) != item:
        inputs["reference"] = other
        inputs["reference_index"] = dataset.item_dir("ingest", other) / "index.json"
        inputs["reference_observe"] = _or_absent(observations_path(dataset, other))
        inputs["reference_labels"] = human_digest(dataset, other)
    return inputs


def _or_absent(path: Path) -> Path | str:
    return path if path.is_file() else "absent"


def run_item(dataset: Dataset, item: str, config: AlignConfig, out: Path) -> dict:
    """Suggest, accept and write ``suggestions.json``, ``peaks.json`` and a contact sheet."""
    index = read_index(dataset, item)
    if not index.cues:
        raise StageError(f"{item}: cues.csv names no expression; add the script's timing")
    dropped: list[dict[str, str]] = []
    rows = suggestion_rows(dataset, index, config, dropped)
    labels = accept(dataset, index, rows, config.accept)
    peaks = {e: _peak_row(label) for e, label in labels.items() if label.frame is not None}
    dropped += _not_taken(index, rows, labels, config.accept)
    if not peaks:
        raise StageError(f"{item}: no expression has a frame ({dropped[0]['why']})")
    _write_json(out / "peaks.json", peaks)
    _write_json(out / "suggestions.json", rows)
    _write_sheet(dataset, index, peaks, out)
    return {
        "expressions": len(index.cues),
        "peaks": len(peaks),
        "by_person": sum(label.annotator != AUTOMATIC for label in labels.values()),
        "matched": sum(row["kind"] == "match" for row in rows.values()),
        "confidence_median": _median([row["confidence"] for row in rows.values()]),
        "dropped": dropped,
    }


def _median(values: list[float]) -> float | None:
    return round(float(np.median(values)), 4) if values else None


def suggestion_rows(
    dataset: Dataset, index: Index, config: AlignConfig, dropped: list[dict[str, str]]
) -> dict[str, dict]:
    """Rows of ``suggestions.json`` by expression; adds to ``dropped`` what stood in the way.

    Without observations there are none: people's labels are then all there is.
    """
    if not observations_path(dataset, index.subject).is_file():
        why = f"{index.subject} is not observed: run 'express50 observe' to see why"
        dropped.append({"what": "suggestions", "why": why})
        return {}
    observations = read_observations(dataset, index.subject)
    subject = watch(index, observations)
    reference = _reference(dataset, index.subject, config, dropped)
    script = {entry.id: entry for entry in load_script()}
    found, canonical = suggest_all(subject, script, reference)
    rows = {e: _suggestion_row(s, subject, e, index) for e, s in found.items()}
    if reference is not None:
        about = {"subject": reference.watched.subject, "camera": reference.watched.camera}
        for expression, frame in canonical.items():
            rows[expression] |= {"kind": "match", "reference": about | {"frame": frame}}
    return rows


def _reference(
    dataset: Dataset, subject: str, config: AlignConfig, dropped: list[dict[str, str]]
) -> Reference | None:
    """The reference identity; None for itself, or where nothing is known of it."""
    other = reference_subject(dataset) if config.match else subject
    if other == subject:
        return None
    if not observations_path(dataset, other).is_file():
        why = f"the reference {other} is not observed; everybody's own peaks were taken"
        dropped.append({"what": "matching", "why": why})
        return None
    said = {
        expression: label
        for expression, label in current_labels(read_labels(dataset, other)).items()
        if label.annotator != AUTOMATIC
    }
    return Reference(
        watch(read_index(dataset, other), read_observations(dataset, other)),
        {e: label.frame for e, label in said.items() if label.frame is not None},
        frozenset(e for e, label in said.items() if label.frame is None),
    )


def accept(
    dataset: Dataset, index: Index, rows: Mapping[str, dict], threshold: float
) -> dict[str, Label]:
    """Append an automatic mark for each sure suggestion that is news; return the labels in force.

    Automatic marks that no suggestion stands for any more are undone. A rerun appends nothing.
    """
    labels = read_labels(dataset, index.subject)

    def write(label: Label) -> None:
        append_label(dataset, label)
        labels.append(label)

    known = _automatic(labels)
    for cue in index.cues:
        expression = cue.expression_id
        row = rows.get(expression)
        if row is None or row["confidence"] < threshold:
            while expression in _automatic(labels):
                write(make_undo(index, expression, AUTOMATIC))
            continue
        old = known.get(expression)
        news = (row["frame"], row["camera"], row["confidence"])
        if old is None or (old.frame, old.camera, old.confidence) != news:
            frame, camera, sure = news
            write(make_mark(index, expression, frame, camera, AUTOMATIC, frame, sure))
    wanted = {cue.expression_id for cue in index.cues}
    return {e: label for e, label in current_labels(labels).items() if e in wanted}


def _automatic(labels: list[Label]) -> dict[str, Label]:
    return current_labels(label for label in labels if label.annotator == AUTOMATIC)


def _not_taken(
    index: Index, rows: Mapping[str, dict], labels: Mapping[str, Label], threshold: float
) -> list[dict[str, str]]:
    """Why expressions have no frame."""
    out = []
    for cue in index.cues:
        expression = cue.expression_id
        label, row = labels.get(expression), rows.get(expression)
        if label is not None and label.frame is None:
            why = f"flagged: {label.reason or 'no reason given'}"
        elif label is not None:
            continue
        elif row is None:
            why = "nothing was seen in its cue window; label it with 'express50 annotate'"
        else:
            why = (
                f"confidence {row['confidence']:.2f} is below align.accept {threshold:g}; label it"
                " with 'express50 annotate'"
            )
        out.append({"what": expression, "why": why})
    return out


def _peak_row(label: Label) -> dict[str, object]:
    names = ("frame", "camera", "pts", "dhash", "confidence", "annotator")
    return {name: getattr(label, name) for name in names}


def _suggestion_row(
    suggestion: Suggestion, subject: Watched, expression: str, index: Index
) -> dict:
    """A suggestion in frames of the footage; curves have a value for every frame of the window."""
    frames = subject.frames[subject.windows[expression]]
    cue = next(c for c in index.cues if c.expression_id == expression)
    every = np.arange(cue.start_frame, min(cue.end_frame, index.frames - 1) + 1)

    def curve(values: np.ndarray) -> list[float]:
        return [round(float(v), 3) for v in np.interp(every, frames, values)]

    return {
        "frame": int(frames[suggestion.row]),
        "confidence": round(suggestion.confidence, 4),
        "start": cue.start_frame,
        "activity": curve(suggestion.activity),
        "candidates": [int(frames[row]) for row in suggestion.candidates],
        "match": None if suggestion.match is None else curve(suggestion.match),
        "kind": "peak",
        "reference": None,
        "camera": subject.camera,
    }


def _write_json(path: Path, table: dict) -> None:
    path.write_text(json.dumps(table, indent=1, sort_keys=True) + "\n")


def _write_sheet(dataset: Dataset, index: Index, peaks: dict, out: Path) -> None:
    """QC: the chosen frame of every expression, between its window's first and last frame."""
    rows, names = [], []
    for cue in index.cues:
        if cue.expression_id not in peaks:
            continue
        peak = peaks[cue.expression_id]
        last = min(cue.end_frame, index.frames - 1)
        frames = [cue.start_frame, peak["frame"], last]
        rows.append([read_proxy(dataset, index.subject, peak["camera"], int(f)) for f in frames])
        names.append(f"{cue.expression_id}: first, taken {frames[1]}, last")
    (out / "qc").mkdir()
    write_image(out / "qc" / "peaks.jpg", contact_sheet(rows, names), quality=85)
