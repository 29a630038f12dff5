"""The worklist of an annotator: canonical frames first, then the least sure suggestions."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from annotations.store import labels_of, read_labels
from annotations.suggestions import Suggested, read_suggestions, reference_subject
from express50.capture.index import read_index
from express50.contract.exclusions import included_subjects
from express50.contract.layout import Dataset
from express50.errors import AnnotationError

ORDERS = ("doubt", "expression", "subject")


@dataclass(frozen=True)
class LabelTask:
    """One label to give; doubt is 1 - confidence of the suggestion, 1 where there is none."""

    subject: str
    expression: str
    doubt: float


def worklist(
    dataset: Dataset,
    annotator: str,
    subjects: Collection[str] | None = None,
    expressions: Collection[str] | None = None,
    order: str = "doubt",
    everything: bool = False,
) -> list[LabelTask]:
    """List the tasks of an annotator, the reference's first in every order.

    Args:
        dataset: the dataset; excluded subjects have no tasks.
        annotator: whose own labels count as done; nobody else's do.
        subjects: only these; all by default.
        expressions: only these; all by default.
        order: ``doubt`` (least sure first), ``expression`` (one across all subjects, then the
            next, in the order of the cues) or ``subject``.
        everything: also what the annotator has labelled.

    Raises:
        AnnotationError: unknown order or subject.
    """
    if order not in ORDERS:
        raise AnnotationError(f"order {order!r}, expected one of {', '.join(ORDERS)}")
    known = included_subjects(dataset)
    unknown = sorted(set(subjects or ()) - set(known))
    if unknown:
        raise AnnotationError(
            f"{dataset.root}: subject {unknown[0]!r} is not ingested or is excluded;"
            f" expected one of {', '.join(known)}"
        )
    if not known:
        return []
    reference = reference_subject(dataset)
    chosen = sorted(subjects or known, key=lambda s: (s != reference, s))
    tasks = [
        (task, position)
        for subject in chosen
        for position, task in enumerate(_tasks_of(dataset, subject, annotator, everything))
        if task is not None and (expressions is None or task.expression in expressions)
    ]
    if order == "doubt":
        tasks.sort(key=lambda row: (row[0].subject != reference, -row[0].doubt))
    elif order == "expression":
        tasks.sort(key=lambda row: row[1])
    return [task for task, _ in tasks]


def _tasks_of(
    dataset: Dataset, subject: str, annotator: str, everything: bool
) -> list[LabelTask | None]:
    """List one entry per cue, None where it is done."""
    done = {} if everything else labels_of(read_labels(dataset, subject), annotator)
    suggestions = read_suggestions(dataset, subject)
    return [
        None
        if cue.expression_id in done
        else LabelTask(subject, cue.expression_id, _doubt(suggestions.get(cue.expression_id)))
        for cue in read_index(dataset, subject).cues
    ]


def _doubt(suggestion: Suggested | None) -> float:
    return 1.0 if suggestion is None else 1.0 - suggestion.confidence
