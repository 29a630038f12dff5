"""The align stage's work: suggestions, those that are accepted, and the peak frames in force."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from annotations.align.features import Features, expression_values, measure
from annotations.align.suggest import (
    Canonical,
    Suggestion,
    canonical_of,
    strongest_event,
    suggest,
    suggest_rest,
    unrest,
)
from annotations.labels import AUTOMATIC, Label, make_mark, make_undo
from annotations.observe.observations import (
    NEUTRAL,
    SEEN_SCORE,
    FaceObservations,
    observations_path,
    read_observations,
)
from annotations.store import append_label, current_labels, read_labels
from annotations.suggestions import Suggested, reference_subject
from express50.capture.expressions import Expression, load_script
from express50.capture.frames import read_proxy
from express50.capture.index import Index, read_index
from express50.contract.layout import Dataset
from express50.contract.stage import Note, Result
from express50.errors import StageError
from express50.files.images import contact_sheet, write_image


def run(dataset: Dataset, item: str, out: Path, *, accept: float, match: bool) -> Result:
    """Suggest, accept and write ``suggestions.json``, ``peaks.json`` and a contact sheet."""
    index = read_index(dataset, item)
    if not index.cues:
        raise StageError(f"{item}: cues.csv names no expression; add the script's timing")
    found, dropped = suggest_for(dataset, index, match)
    labels = accept_sure(dataset, index, found, accept)
    dropped += _not_taken(index, found, labels, accept)
    peaks = {e: label for e, label in labels.items() if label.frame is not None}
    if not peaks:
        raise StageError(f"{item}: no expression has a frame ({dropped[0].why})")
    kept = ("frame", "camera", "pts", "dhash", "confidence", "annotator")
    rows = {e: {name: getattr(label, name) for name in kept} for e, label in peaks.items()}
    _write_json(out / "peaks.json", rows)
    _write_json(out / "suggestions.json", {e: asdict(s) for e, s in found.items()})
    _write_sheet(dataset, index, peaks, out)
    sure = [suggested.confidence for suggested in found.values()]
    metrics = {
        "expressions": len(index.cues),
        "peaks": len(peaks),
        "by_person": sum(label.annotator != AUTOMATIC for label in labels.values()),
        "matched": sum(suggested.kind == "match" for suggested in found.values()),
        "confidence_median": round(float(np.median(sure)), 4) if sure else None,
    }
    return Result(metrics, dropped)


def suggest_for(
    dataset: Dataset, index: Index, match: bool
) -> tuple[dict[str, Suggested], list[Note]]:
    """Suggest a frame of every expression, and note what was missing for it.

    Without observations nothing is suggested: only people's labels count then.
    """
    if not observations_path(dataset, index.subject).is_file():
        why = f"{index.subject} is not observed: run 'express50 observe' to see why"
        return {}, [Note("suggestions", why)]
    other = reference_subject(dataset) if match else index.subject
    reference, dropped = None, []
    if other != index.subject and observations_path(dataset, other).is_file():
        people = {
            expression: label
            for expression, label in current_labels(read_labels(dataset, other)).items()
            if label.annotator != AUTOMATIC
        }
        reference = Reference(
            watch(read_index(dataset, other), read_observations(dataset, other)),
            {e: label.frame for e, label in people.items() if label.frame is not None},
            frozenset(e for e, label in people.items() if label.frame is None),
        )
    elif other != index.subject:
        why = f"the reference {other} is not observed; every subject's own peaks were taken"
        dropped.append(Note("matching", why))
    subject = watch(index, read_observations(dataset, index.subject))
    script = {entry.id: entry for entry in load_script()}
    found, canonical = suggest_all(subject, script, reference)
    rows = {e: _in_footage(s, subject, e, index) for e, s in found.items()}
    if reference is not None:
        about = {"subject": reference.watched.subject, "camera": reference.watched.camera}
        for expression, frame in canonical.items():
            matched = replace(rows[expression], kind="match", reference=about | {"frame": frame})
            rows[expression] = matched
    return rows, dropped


def accept_sure(
    dataset: Dataset, index: Index, found: Mapping[str, Suggested], threshold: float
) -> dict[str, Label]:
    """Append an automatic mark for each sure suggestion that is news; return the labels in force.

    Automatic marks that no suggestion supports any more are undone. A rerun appends nothing.
    """
    labels = read_labels(dataset, index.subject)

    def write(label: Label) -> None:
        append_label(dataset, label)
        labels.append(label)

    known = _automatic(labels)
    for cue in index.cues:
        expression = cue.expression_id
        suggested = found.get(expression)
        if suggested is None or suggested.confidence < threshold:
            while expression in _automatic(labels):
                write(make_undo(index, expression, AUTOMATIC))
            continue
        frame, camera, sure = suggested.frame, suggested.camera, suggested.confidence
        old = known.get(expression)
        if old is None or (old.frame, old.camera, old.confidence) != (frame, camera, sure):
            mark = make_mark(index, expression, frame, camera, AUTOMATIC)
            write(replace(mark, suggested=frame, confidence=sure))
    wanted = {cue.expression_id for cue in index.cues}
    return {e: label for e, label in current_labels(labels).items() if e in wanted}


def _automatic(labels: list[Label]) -> dict[str, Label]:
    return current_labels(label for label in labels if label.annotator == AUTOMATIC)


def _not_taken(
    index: Index, found: Mapping[str, Suggested], labels: Mapping[str, Label], threshold: float
) -> list[Note]:
    """Note the expressions that have no frame, with the reason."""
    notes = []
    for expression in (cue.expression_id for cue in index.cues):
        label, suggested = labels.get(expression), found.get(expression)
        if label is not None and label.frame is not None:
            continue
        if label is not None:
            why = f"flagged: {label.reason or 'no reason given'}"
        elif suggested is None:
            why = "no face was seen in its cue window; label it with 'express50 annotate'"
        else:
            why = (
                f"confidence {suggested.confidence:.2f} is below align.accept {threshold:g};"
                " label it with 'express50 annotate'"
            )
        notes.append(Note(expression, why))
    return notes


def _in_footage(found: Suggestion, subject: Watched, expression: str, index: Index) -> Suggested:
    """Express a suggestion in the footage's frames, its curves per frame of the cue window."""
    frames = subject.frames[subject.windows[expression]]
    cue = next(c for c in index.cues if c.expression_id == expression)
    every = np.arange(cue.start_frame, min(cue.end_frame, index.frames - 1) + 1)

    def curve(values: np.ndarray) -> list[float]:
        return [round(float(v), 3) for v in np.interp(every, frames, values)]

    return Suggested(
        frame=int(frames[found.row]),
        confidence=round(found.confidence, 4),
        start=cue.start_frame,
        activity=curve(found.activity),
        candidates=[int(frames[row]) for row in found.candidates],
        match=None if found.match is None else curve(found.match),
        camera=subject.camera,
    )


def _write_json(path: Path, table: dict) -> None:
    path.write_text(json.dumps(table, indent=1, sort_keys=True) + "\n")


def _write_sheet(dataset: Dataset, index: Index, peaks: Mapping[str, Label], out: Path) -> None:
    """Show the peak frame of every expression between its window's first and last frame."""
    rows, names = [], []
    for cue in index.cues:
        peak = peaks.get(cue.expression_id)
        if peak is None or peak.frame is None:
            continue
        frames = (cue.start_frame, peak.frame, min(cue.end_frame, index.frames - 1))
        rows.append([read_proxy(dataset, index.subject, peak.camera or "", f) for f in frames])
        names.append(f"{cue.expression_id}: first, taken {peak.frame}, last")
    (out / "qc").mkdir()
    write_image(out / "qc" / "peaks.jpg", contact_sheet(rows, names), quality=85)


@dataclass(frozen=True)
class Watched:
    """A subject's features by cue window.

    Attributes:
        subject: id.
        camera: that sees the face best.
        frames: (F,) observed frames.
        windows: expression id -> rows of ``frames`` in its cue window that show the face; none is
            empty.
        features: of those rows.
    """

    subject: str
    camera: str
    frames: np.ndarray
    windows: dict[str, np.ndarray]
    features: Features


@dataclass(frozen=True)
class Reference:
    """The reference identity, and the frames that people chose as canonical, by expression."""

    watched: Watched
    chosen: Mapping[str, int]
    flagged: frozenset[str] = frozenset()


def watch(index: Index, observations: FaceObservations) -> Watched:
    """Measure the features of a subject by cue window.

    Expressions whose window holds no observed frame that shows a face are left out.
    """
    windows = {}
    shown = observations.scores.max(axis=0) >= SEEN_SCORE
    for cue in index.cues:
        seen = (observations.frames >= cue.start_frame) & (observations.frames <= cue.end_frame)
        seen &= shown
        if seen.any():
            windows[cue.expression_id] = np.flatnonzero(seen)
    features = measure(observations, windows)
    return Watched(index.subject, observations.cameras[0], observations.frames, windows, features)


def suggest_all(
    subject: Watched, script: Mapping[str, Expression], reference: Reference | None
) -> tuple[dict[str, Suggestion], dict[str, int]]:
    """Suggest a frame of every expression; name the canonical frame it was matched to.

    Args:
        subject: the subject to suggest for.
        script: the known expressions; for others all of the face counts.
        reference: None where the subject is the reference, or it is not observed.
    """
    groups = subject.features.owner + 68 * subject.features.camera
    found, canonical = {}, {}
    for expression, rows in subject.windows.items():
        entry = script.get(expression)
        values = expression_values(subject.features, entry, rows)
        if expression == NEUTRAL:
            tops = [  # how far expressions usually move the face from rest, in units of noise
                unrest(expression_values(subject.features, entry, window)).max()
                for window in subject.windows.values()
            ]
            found[expression] = suggest_rest(values, groups, float(np.median(tops)))
            continue
        target = None
        if reference is not None and expression in reference.watched.windows:
            target = _target(subject.features, reference, expression, entry)
        if target is not None:
            canonical[expression] = target[0]
        found[expression] = suggest(values, groups, target[1] if target else None)
    return found, canonical


def _target(
    features: Features, reference: Reference, expression: str, entry: Expression | None
) -> tuple[int, Canonical] | None:
    """Express the reference's frame, chosen or else its apex, in the subject's features.

    Return None where people flagged the reference's performance.
    """
    if expression in reference.flagged:
        return None
    theirs = reference.watched
    rows = theirs.windows[expression]
    values = expression_values(theirs.features, entry, rows)
    if expression in reference.chosen:
        row = int(np.argmin(np.abs(theirs.frames[rows] - reference.chosen[expression])))
    else:
        row = strongest_event(values).apex
    frame = reference.chosen.get(expression, int(theirs.frames[rows[row]]))
    shared = shared_columns(features, theirs.features)
    return frame, canonical_of(values, row, shared, features.values.shape[1])


def shared_columns(features: Features, other: Features) -> np.ndarray:
    """Pair the columns (2, K) that measure the same on two subjects.

    Cameras of the same id are paired; where there are none, those that see each face best.
    """
    pairs = [(features.cameras.index(c), other.cameras.index(c)) for c in features.cameras
             if c in other.cameras] or [(0, 0)]  # fmt: skip
    return np.concatenate(
        [
            np.stack([np.flatnonzero(features.camera == a), np.flatnonzero(other.camera == b)])
            for a, b in pairs
        ],
        axis=1,
    )
