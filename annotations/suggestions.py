"""Read and write the align stage's suggestions, and choose the reference identity."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from annotations.labels import current_labels, read_labels
from express50.contract.layout import Dataset, included_subjects
from express50.errors import AnnotationError, FormatError, StageError, advised, check_known
from express50.files.atomic import write_json
from express50.files.text import read_json_table, refusing


@dataclass(frozen=True, kw_only=True)
class Suggested:
    """The suggestion for one expression of one subject."""

    frame: int  # the suggested frame
    confidence: float  # probability that it is at most one frame off, 0 to 1
    start: int  # frame of the curves' first value
    activity: list[float]  # how far the face is from rest, one value per frame of the cue window
    candidates: list[int]  # frames worth a look, best first, at least three frames apart
    # similarity to the reference's canonical frame, 0 to 1 per frame; None for the reference itself
    # and where it has no canonical frame
    match: list[float] | None = None
    kind: str = "peak"  # ``match`` where the reference decided, else ``peak``
    # ``subject``, ``frame`` and ``camera`` of the canonical frame, or None
    reference: dict[str, Any] | None = None
    camera: str = ""  # the camera that sees the face best


def read_suggestions(dataset: Dataset, subject: str) -> dict[str, Suggested]:
    """Read the suggestions by expression; none when the align stage has not run.

    Raises:
        FormatError: the file is not a table of suggestions, or a figure in it is not a number.
    """
    path = dataset.suggestions_file(subject)
    if not path.is_file():
        return {}
    fix = f"run {advised('express50 align', dataset.root)} again"
    with refusing(FormatError, f"{path}: not a table of suggestions", fix):
        rows = read_json_table(path, FormatError, fix)
        found = {expression: Suggested(**row) for expression, row in rows.items()}
        for expression, row in found.items():
            if not all(type(n) is int for n in (row.frame, row.start, *row.candidates)):
                raise ValueError(f"{expression}: frames are not integers")
            if not 0.0 <= row.confidence <= 1.0:
                raise ValueError(f"{expression}: confidence is {row.confidence}, expected 0 to 1")
            if not all(map(math.isfinite, [*row.activity, *(row.match or ())])):
                raise ValueError(f"{expression}: its curves hold NaN or infinity")
    return found


@dataclass(frozen=True)
class CanonicalFrame:
    """The reference's frame of one expression; ``by`` is who chose it."""

    subject: str
    frame: int
    camera: str
    by: str


def reference_file(dataset: Dataset) -> Path:
    """Return the file that holds the choice of the reference."""
    return dataset.root / "labels" / "reference.json"


def reference_subject(dataset: Dataset) -> str:
    """Find the reference identity: the one that was chosen, else the first that is not excluded.

    Raises:
        StageError: nothing is ingested, or everybody is excluded.
        AnnotationError: the chosen subject is no longer in the dataset, or is excluded.
    """
    subjects = included_subjects(dataset)
    if not subjects:
        ingest = advised("express50 ingest", dataset.root, "CAPTURE")
        raise StageError(f"{dataset.root}: no subject; run {ingest} first")
    path = reference_file(dataset)
    if not path.is_file():
        return subjects[0]
    choose = advised("express50 annotate reference", dataset.root, "SUBJECT")
    chosen = read_json_table(path, AnnotationError, f"choose one with {choose}").get("subject")
    if chosen not in subjects:
        raise AnnotationError(
            f"{path}: reference {chosen!r} is not ingested or is excluded; choose one of"
            f" {', '.join(subjects)} with {choose}"
        )
    return chosen


def choose_reference(dataset: Dataset, subject: str) -> None:
    """Make a subject the reference; AnnotationError if it is not ingested, or excluded."""
    check_known(str(dataset.root), "included subject", [subject], included_subjects(dataset))
    write_json(reference_file(dataset), {"subject": subject})


def canonical(dataset: Dataset, expression: str) -> CanonicalFrame | None:
    """Find the reference's frame of an expression: its label in force, else its suggestion.

    None if the reference has neither, or its performance is flagged.
    """
    subject = reference_subject(dataset)
    label = current_labels(read_labels(dataset, subject)).get(expression)
    if label is not None:
        if label.frame is None or label.camera is None:
            return None
        return CanonicalFrame(subject, label.frame, label.camera, label.annotator)
    suggestion = read_suggestions(dataset, subject).get(expression)
    if suggestion is None:
        return None
    return CanonicalFrame(subject, suggestion.frame, suggestion.camera, "suggestion")
