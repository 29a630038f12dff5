"""Write suggestions, those that are accepted, and the peak frames in force."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from annotations.align.features import Features, measure_features
from annotations.align.suggest import PLATEAU_SHARE, STILL, Reference, Suggestion, suggest_all
from annotations.labels import (
    AUTOMATIC,
    Label,
    append_label,
    current_labels,
    footage_problems,
    lost_frame,
    make_event,
    make_mark,
    read_labels,
    unreadable_lines,
)
from annotations.observe.stage import cue_frames, read_observations
from annotations.suggestions import Suggested, reference_subject
from express50.capture.expressions import load_script
from express50.capture.frames import read_proxy
from express50.capture.index import Index, read_index
from express50.contract.layout import Dataset
from express50.contract.stage import ExpectedError, Note, Result
from express50.error_model import error_bounds
from express50.errors import StageError, advised
from express50.files.atomic import write_json
from express50.files.images import write_image
from express50.geometry.pixels import contact_sheet


def run(dataset: Dataset, item: str, out: Path, *, accept: float, match: bool) -> Result:
    """Suggest, accept and write ``suggestions.json``, ``peaks.json`` and a contact sheet."""
    index = read_index(dataset, item)
    if not index.cues:
        raise StageError(
            f"{item}: cues.csv names no expression; add rows expression_id,start_frame,end_frame,"
            f" then run {advised('express50 ingest', dataset.root)} again"
        )
    found, dropped = suggest_for(dataset, index, match)
    labels = accept_sure(dataset, index, found, accept)
    dropped += _missing_peaks(dataset, index, found, labels, accept)
    peaks = {e: x for e, x in labels.items() if x.frame is not None and not lost_frame(index, x)}
    if not peaks:
        raise StageError(f"{item}: no expression has a frame ({dropped[0].why})")
    kept = ("frame", "camera", "pts", "dhash", "confidence", "annotator")
    rows = {e: {name: getattr(label, name) for name in kept} for e, label in peaks.items()}
    write_json(out / "peaks.json", rows)
    write_json(out / "suggestions.json", {e: asdict(s) for e, s in found.items()})
    _write_sheet(dataset, index, peaks, out)
    sure = [suggested.confidence for suggested in found.values()]
    metrics = {
        "expressions": len(index.cues),
        "peaks": len(peaks),
        "by_person": sum(label.annotator != AUTOMATIC for label in labels.values()),
        "matched": sum(suggested.kind == "match" for suggested in found.values()),
        "confidence_median": round(float(np.median(sure)), 4) if sure else None,
    }
    taken = [s for e, s in found.items() if e in peaks and peaks[e].annotator == AUTOMATIC]
    name = dataset.labels_file(index.subject).name
    warnings = [
        Note("labels", f"line {number} of {name} cannot be read; label its expression again")
        for number in unreadable_lines(dataset, index.subject)
    ]
    return Result(
        metrics, dropped, warnings + _outside(index, peaks), expected_error=expected_error(taken)
    )


def expected_error(taken: Sequence[Suggested]) -> ExpectedError | None:
    """Estimate how many frames off suggestions are; None if people chose every peak."""
    figures = [error_figures(suggested) for suggested in taken]
    if not figures:
        return None
    joined = {name: np.array([row[name] for row in figures]) for name in figures[0]}
    return error_bounds("align", joined).expected


def error_figures(suggested: Suggested) -> dict[str, float]:
    """Describe how well a peak is known: its width in frames, its height, and its confidence."""
    activity = np.array(suggested.activity)
    top = float(activity.max(initial=0.0))
    return {
        "width": float(max((activity >= PLATEAU_SHARE * top).sum(), 1)),
        "flatness": STILL / max(top, 1e-3),
        "doubt": 1.02 - suggested.confidence,
    }


def suggest_for(
    dataset: Dataset, index: Index, match: bool
) -> tuple[dict[str, Suggested], list[Note]]:
    """Suggest a frame for every expression, and note missing inputs.

    Without observations nothing is suggested: only people's labels count then.
    """
    if not dataset.observations_file(index.subject).is_file():
        again = advised("express50 observe", dataset.root)
        why = f"{index.subject} is not observed: run {again} to see why"
        return {}, [Note("suggestions", why)]
    other = reference_subject(dataset) if match else index.subject
    reference, dropped = None, []
    if other != index.subject and dataset.observations_file(other).is_file():
        people = {
            expression: label
            for expression, label in current_labels(read_labels(dataset, other)).items()
            if label.annotator != AUTOMATIC
        }
        chosen = {e: label.frame for e, label in people.items() if label.frame is not None}
        theirs = measure_features(read_index(dataset, other), read_observations(dataset, other))
        flagged = people.keys() - chosen.keys()
        windows = {e: rows for e, rows in theirs.windows.items() if e not in flagged}
        reference = Reference(replace(theirs, windows=windows), chosen)
    elif other != index.subject:
        why = f"the reference {other} is not observed, so the subject's own peaks were taken"
        dropped.append(Note("matching", why))
    features = measure_features(index, read_observations(dataset, index.subject))
    script = {entry.id: entry for entry in load_script()}
    found, canonical = suggest_all(features, script, reference)
    rows = {e: _in_footage(s, features, e, index) for e, s in found.items()}
    if reference is not None:
        about = {"subject": other, "camera": reference.features.cameras[0]}
        for expression, frame in canonical.items():
            matched = replace(rows[expression], kind="match", reference=about | {"frame": frame})
            rows[expression] = matched
    return rows, dropped


def accept_sure(
    dataset: Dataset, index: Index, found: Mapping[str, Suggested], threshold: float
) -> dict[str, Label]:
    """Append an automatic mark for each new sure suggestion; return the labels in force.

    Automatic marks that no suggestion supports any more are undone. A rerun appends nothing.
    """
    labels = read_labels(dataset, index.subject)

    def write(label: Label) -> None:
        labels.append(append_label(dataset, label))

    known = _automatic(labels)
    for cue in index.cues:
        expression = cue.expression_id
        suggested = found.get(expression)
        if suggested is None or suggested.confidence < threshold:
            while expression in _automatic(labels):
                write(make_event(index, expression, "undo", AUTOMATIC))
            continue
        frame, camera, sure = suggested.frame, suggested.camera, suggested.confidence
        mark = make_mark(index, expression, frame, camera, AUTOMATIC)
        mark, old = replace(mark, suggested=frame, confidence=sure), known.get(expression)
        if old is None or _shown(old) != _shown(mark):
            write(mark)
    wanted = {cue.expression_id for cue in index.cues}
    return {e: label for e, label in current_labels(labels).items() if e in wanted}


def _shown(mark: Label) -> tuple[object, ...]:
    """Return what a mark says; other footage has other hashes at the same frame."""
    return mark.frame, mark.camera, mark.confidence, mark.pts, mark.dhash


def _automatic(labels: list[Label]) -> dict[str, Label]:
    return current_labels(label for label in labels if label.annotator == AUTOMATIC)


def _missing_peaks(
    dataset: Dataset, index: Index, found: Mapping[str, Suggested], labels: Mapping[str, Label],
    threshold: float,
) -> list[Note]:  # fmt: skip
    """Note the expressions that have no frame, with the reason."""
    place = f"{index.subject} EXPRESSION FRAME"  # expressions of one reason share a line
    mark, notes = advised("express50 annotate mark", dataset.root, place), []
    for expression in (cue.expression_id for cue in index.cues):
        label, suggested = labels.get(expression), found.get(expression)
        if label is not None and (gone := lost_frame(index, label)):
            why = f"labelled by {label.annotator}: {gone}; label it again: {mark}"
        elif label is not None and label.frame is not None:
            continue
        elif label is not None:
            why = f"flagged: {label.reason or 'no reason given'}"
        elif suggested is None:
            why = f"no face was seen in its cue window; to label it: {mark}"
        else:
            why = (
                f"confidence {suggested.confidence:.2f} is below align.accept {threshold:g};"
                f" to label it: {mark}"
            )
        notes.append(Note(expression, why))
    return notes


def _outside(index: Index, peaks: Mapping[str, Label]) -> list[Note]:
    """Warn of peaks outside their cue windows: they may show another expression."""
    again = "label it again if cues.csv has changed"
    return [
        Note(expression, f"labelled by {label.annotator}: {what}; {again}")
        for expression, label in peaks.items()
        for _, what in footage_problems(index, label)
    ]


def _in_footage(found: Suggestion, features: Features, expression: str, index: Index) -> Suggested:
    """Express a suggestion in the footage's frames, its curves per frame of the cue window."""
    frames = features.frames[features.windows[expression]]
    cue = next(c for c in index.cues if c.expression_id == expression)
    every = cue_frames(index, cue)

    def curve(values: np.ndarray) -> list[float]:
        return [round(float(v), 3) for v in np.interp(every, frames, values)]

    return Suggested(
        frame=int(frames[found.row]),
        confidence=round(found.confidence, 4),
        start=cue.start_frame,
        activity=curve(found.activity),
        candidates=[int(frames[row]) for row in found.candidates],
        match=None if found.match is None else curve(found.match),
        camera=features.cameras[0],
    )


def _write_sheet(dataset: Dataset, index: Index, peaks: Mapping[str, Label], out: Path) -> None:
    """Show the peak frame of every expression between its window's first and last frame."""
    rows, names = [], []
    for cue in index.cues:
        peak = peaks.get(cue.expression_id)
        if peak is None or peak.frame is None:
            continue
        frames = (cue.start_frame, peak.frame, min(cue.end_frame, index.frames - 1))
        rows.append([read_proxy(dataset, index.subject, peak.camera or "", f) for f in frames])
        names.append([f"{cue.expression_id}: first", f"taken: {peak.frame}", "last"])
    (out / "qc").mkdir()
    write_image(out / "qc" / "peaks.jpg", contact_sheet(rows, names), quality=85)
