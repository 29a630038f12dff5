"""Checks of every label against the footage it names, and of people against each other.

The installed hook ``label_problems`` names this module; see ``pyproject.toml``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from annotations.agreement import disagreements
from annotations.labels import Label, find_cue
from annotations.store import current_labels, read_labels, unreadable_lines
from express50.capture.index import Index, read_index
from express50.contract.exclusions import included_subjects
from express50.contract.layout import Dataset
from express50.errors import AnnotationError


@dataclass(frozen=True)
class LabelProblem:
    """Something wrong with a label.

    Kinds: ``identity`` (the frame is not the one that was labelled), ``window`` (outside the cue),
    ``unknown`` (no such expression or camera), ``contradiction`` (a peak for one, none for another,
    not settled), ``unreadable`` (a line cut short, or damaged) and ``coverage`` (no label in
    force).
    """

    subject: str
    expression: str
    kind: str
    what: str


def problems(dataset: Dataset, subjects: list[str] | None = None) -> list[LabelProblem]:
    """List the problems of some subjects' labels, of all that are not excluded by default."""
    chosen = included_subjects(dataset) if subjects is None else subjects
    found = []
    for subject in chosen:
        index, labels = read_index(dataset, subject), read_labels(dataset, subject)
        for number in unreadable_lines(dataset, subject):
            what = f"line {number} of {dataset.labels_file(subject)} cannot be read; label it again"
            found.append(LabelProblem(subject, "", "unreadable", what))
        for label in labels:
            for kind, what in _footage_problems(index, label):
                words = f"{label.annotator}: {what}"
                found.append(LabelProblem(subject, label.expression, kind, words))
        force = current_labels(labels)
        for cue in index.cues:
            if cue.expression_id not in force:
                found.append(LabelProblem(subject, cue.expression_id, "coverage", "no label"))
    for row in disagreements(dataset, subjects=chosen):
        if row.spread is None:
            said = ", ".join(f"{who}: {what}" for who, what in row.said.items())
            what = f"{said}; settle it with 'express50 annotate review --settle'"
            found.append(LabelProblem(row.subject, row.expression, "contradiction", what))
    return found


def _footage_problems(index: Index, label: Label) -> Iterator[tuple[str, str]]:
    """Compare one event with the footage; give the kind and the words of each problem."""
    if not label.expression:  # about the whole subject
        return
    try:
        cue = find_cue(index, label.expression)
    except AnnotationError as error:
        yield "unknown", str(error)
        return
    if label.frame is None:
        return
    source = index.cameras.get(label.camera or "")
    if source is None:
        yield "unknown", f"no camera {label.camera!r}"
        return
    for name in ("first", "frame", "last"):
        frame = getattr(label, name)
        if frame is not None and not cue.start_frame <= frame <= cue.end_frame:
            yield (
                "window",
                f"{name} {frame} lies outside the cue window {cue.start_frame} to {cue.end_frame}",
            )
    if not 0 <= label.frame < source.frames:
        yield "identity", f"frame {label.frame} does not exist in {label.camera}"
    elif (source.pts[label.frame], source.dhash[label.frame]) != (label.pts, label.dhash):
        yield (
            "identity",
            f"frame {label.frame} of {label.camera} has pts {source.pts[label.frame]} and hash"
            f" {source.dhash[label.frame]}, the label says {label.pts} and {label.dhash}",
        )
