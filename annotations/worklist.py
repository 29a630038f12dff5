"""List an annotator's work, the coverage of a dataset, and what labels have cost so far."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from statistics import median

from annotations.labels import (
    Label,
    current_labels,
    is_person,
    labels_of,
    origin,
    read_labels,
    voices,
)
from annotations.suggestions import read_suggestions, reference_subject
from express50.capture.demographics import age_counts, gender_counts, shown_counts
from express50.capture.index import read_index
from express50.capture.readers.read import read_people
from express50.contract.layout import Dataset, exclusion_reason, included_subjects
from express50.errors import check_known

ORDERS = ("doubt", "expression", "subject")


@dataclass(frozen=True)
class LabelTask:
    """One label to give; doubt is 1 - confidence of the suggestion, or 1 without one."""

    subject: str
    expression: str
    doubt: float

    @property
    def key(self) -> tuple[str, str]:
        """Return the subject and expression."""
        return self.subject, self.expression


def worklist(
    dataset: Dataset,
    annotator: str,
    subjects: Collection[str] | None = None,
    expressions: Collection[str] | None = None,
    order: str = "doubt",
    everything: bool = False,
) -> list[LabelTask]:
    """List the tasks of an annotator, the reference's first in every order.

    Excluded subjects have no tasks. What this annotator has labelled is done, and is listed only
    with `everything`; the labels of others do not count. The `order` is ``doubt`` (least sure
    first), ``expression`` (one across all subjects, then the next, in the order of the cues) or
    ``subject``.

    Raises:
        AnnotationError: a subject is not in the dataset, or is excluded.
    """
    known = included_subjects(dataset)
    check_known(str(dataset.root), "included subject", subjects or (), known)
    if not known:
        return []
    reference = reference_subject(dataset)
    chosen = sorted(subjects or known, key=lambda s: (s != reference, s))
    tasks, places = [], dict[str, int]()  # places of expressions: subjects may lack some
    for subject in chosen:
        done = {} if everything else labels_of(read_labels(dataset, subject), annotator)
        suggestions = read_suggestions(dataset, subject)
        doubts = {name: 1.0 - found.confidence for name, found in suggestions.items()}
        for cue in read_index(dataset, subject).cues:
            name = cue.expression_id
            places.setdefault(name, len(places))
            if name not in done and (expressions is None or name in expressions):
                tasks.append(LabelTask(subject, name, doubts.get(name, 1.0)))
    if order == "doubt":
        tasks.sort(key=lambda task: (task.subject != reference, -task.doubt))
    elif order == "expression":
        tasks.sort(key=lambda task: places[task.expression])
    return tasks


def coverage(dataset: Dataset) -> dict[str, dict]:
    """Compute the coverage of the subjects that are not excluded.

    Returns:
        ``cells`` (subject -> expression -> ``person``, ``rule``, ``auto``, ``flagged`` or
        ``missing``), ``missing`` (subject -> expressions), ``excluded`` (subject -> reason),
        ``gender`` and ``age`` counts of five or more people, where captures state them.
    """
    cells = {subject: _states(dataset, subject) for subject in included_subjects(dataset)}
    missing = {
        subject: [e for e, state in row.items() if state == "missing"]
        for subject, row in cells.items()
    }
    reasons = {s: exclusion_reason(dataset, s) for s in dataset.subjects()}
    people = read_people(dataset, cells)
    return {
        "cells": cells,
        "missing": {subject: row for subject, row in missing.items() if row},
        "excluded": {s: reason for s, reason in reasons.items() if reason is not None},
        "gender": shown_counts(gender_counts(people)),
        "age": shown_counts(age_counts(people)),
    }


def progress(dataset: Dataset, subject: str) -> dict[str, object]:
    """Count a subject's expressions by who labelled them."""
    states = _states(dataset, subject)
    count = Counter(states.values())
    return {
        "subject": subject,
        "expressions": len(states),
        "by_person": count["person"],
        "by_rule": count["rule"],
        "automatic": count["auto"],
        "flagged": count["flagged"],
        "excluded": exclusion_reason(dataset, subject),
    }


def _states(dataset: Dataset, subject: str) -> dict[str, str]:
    """Return who labelled each expression of a subject's cues, as `origin` does, or ``missing``."""
    force = current_labels(read_labels(dataset, subject))
    names = [cue.expression_id for cue in read_index(dataset, subject).cues]
    return {name: origin(force[name]) if name in force else "missing" for name in names}


def effort(dataset: Dataset) -> dict[str, dict[str, object]]:
    """Count each person's labels in force; their time and keys include what was undone."""
    spent: dict[str, list[Label]] = defaultdict(list)
    force: dict[str, list[Label]] = defaultdict(list)
    for subject in dataset.subjects():
        events = read_labels(dataset, subject)
        for label in events:
            if is_person(label.annotator) and label.action in ("mark", "flag"):
                spent[label.annotator].append(label)
        for who, label in (pair for own in voices(events).values() for pair in own.items()):
            force[who].append(label)
    figures: dict[str, dict[str, object]] = {}
    for who, labels in sorted(spent.items()):
        followed = [x.frame == x.suggested for x in force[who] if x.suggested is not None]
        figures[who] = {
            "labels": len(force[who]),
            "seconds_median": _median(x.seconds for x in labels),
            "seconds_total": round(sum(x.seconds or 0.0 for x in labels), 1),
            "keys_median": _median(x.keys for x in labels),
            "accepted_share": round(sum(followed) / len(followed), 4) if followed else None,
        }
    return figures


def _median(values: Iterable[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return round(float(median(known)), 3) if known else None
