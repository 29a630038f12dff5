"""Progress: coverage of subjects and expressions, and the effort of each annotator."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from statistics import median

from annotations.labels import AUTOMATIC, Label
from annotations.store import current_labels, is_person, read_labels
from express50.capture.demographics import age_counts, gender_counts, shown_counts
from express50.capture.index import read_index
from express50.capture.readers.read import read_people
from express50.contract.exclusions import exclusion_reason, included_subjects
from express50.contract.layout import Dataset


def coverage(dataset: Dataset) -> dict[str, dict]:
    """Compute the coverage of the subjects that are not excluded.

    Returns:
        ``cells`` (subject -> expression -> ``person``, ``rule``, ``auto``, ``flagged`` or
        ``missing``), ``missing`` (subject -> expressions), ``excluded`` (subject -> reason),
        ``gender`` and ``age`` counts of five or more people, where captures state them.
    """
    cells = {subject: _cells(dataset, subject) for subject in included_subjects(dataset)}
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


def _cells(dataset: Dataset, subject: str) -> dict[str, str]:
    force = current_labels(read_labels(dataset, subject))
    cues = read_index(dataset, subject).cues
    return {c.expression_id: _state(force.get(c.expression_id)) for c in cues}


def _state(label: Label | None) -> str:
    if label is None:
        return "missing"
    if label.frame is None:
        return "flagged"
    if label.annotator == AUTOMATIC:
        return "auto"
    return "person" if is_person(label.annotator) else "rule"


def progress(dataset: Dataset, subject: str) -> dict[str, object]:
    """Count a subject's expressions by who labelled them."""
    labels = current_labels(read_labels(dataset, subject)).values()
    marks = [x for x in labels if x.frame is not None]
    return {
        "subject": subject,
        "expressions": len(read_index(dataset, subject).cues),
        "by_person": sum(is_person(x.annotator) for x in marks),
        "by_rule": sum(not is_person(x.annotator) and x.annotator != AUTOMATIC for x in marks),
        "automatic": sum(x.annotator == AUTOMATIC for x in marks),
        "flagged": sum(x.frame is None for x in labels),
        "excluded": exclusion_reason(dataset, subject),
    }


def effort(dataset: Dataset) -> dict[str, dict[str, object]]:
    """Sum each person's effort over all subjects; marks and flags that were undone count too."""
    spent: dict[str, list[Label]] = defaultdict(list)
    for subject in dataset.subjects():
        for label in read_labels(dataset, subject):
            if is_person(label.annotator) and label.action in ("mark", "flag"):
                spent[label.annotator].append(label)
    return {who: _figures(labels) for who, labels in sorted(spent.items())}


def _figures(labels: Sequence[Label]) -> dict[str, object]:
    followed = [x.frame == x.suggested for x in labels if x.suggested is not None]
    return {
        "labels": len(labels),
        "seconds_median": _median(x.seconds for x in labels),
        "seconds_total": round(sum(x.seconds or 0.0 for x in labels), 1),
        "keys_median": _median(x.keys for x in labels),
        "accepted_share": round(sum(followed) / len(followed), 4) if followed else None,
    }


def _median(values: Iterable[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return round(float(median(known)), 3) if known else None
