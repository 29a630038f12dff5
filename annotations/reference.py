"""The reference identity, whose frame of each expression everybody else is matched to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from annotations.store import current_labels, read_labels
from annotations.suggestions import read_suggestions
from express50.contract.exclusions import included_subjects
from express50.contract.layout import Dataset
from express50.errors import AnnotationError, StageError
from express50.files.atomic import write_json
from express50.files.text import read_json_table


@dataclass(frozen=True)
class CanonicalFrame:
    """The reference's frame of one expression; ``by`` is who chose it."""

    subject: str
    frame: int
    camera: str
    by: str


def reference_file(dataset: Dataset) -> Path:
    """Where the choice of the reference is kept."""
    return dataset.root / "labels" / "reference.json"


def reference_subject(dataset: Dataset) -> str:
    """The reference identity: the one that was chosen, else the first that is not excluded.

    Raises:
        StageError: nothing is ingested, or everybody is excluded.
        AnnotationError: the chosen subject is not in the dataset any more, or is excluded.
    """
    subjects = included_subjects(dataset)
    if not subjects:
        raise StageError(f"{dataset.root}: no subject; run 'express50 ingest' first")
    path = reference_file(dataset)
    if not path.is_file():
        return subjects[0]
    again = "choose one with 'express50 annotate reference'"
    chosen = read_json_table(path, AnnotationError, again).get("subject")
    if chosen not in subjects:
        raise AnnotationError(
            f"{path}: reference {chosen!r} is not ingested or is excluded; choose one of"
            f" {', '.join(subjects)} with 'express50 annotate reference'"
        )
    return chosen


def choose_reference(dataset: Dataset, subject: str) -> None:
    """Make a subject the reference.

    Raises:
        AnnotationError: it is not ingested, or excluded.
    """
    subjects = included_subjects(dataset)
    if subject not in subjects:
        raise AnnotationError(
            f"{dataset.root}: no subject {subject!r} to refer to; expected one of"
            f" {', '.join(subjects) or 'none: run express50 ingest'}"
        )
    write_json(reference_file(dataset), {"subject": subject})


def canonical(dataset: Dataset, expression: str) -> CanonicalFrame | None:
    """The reference's frame of an expression: its label in force, else its suggestion.

    None where the reference has neither, or its performance is flagged.
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
