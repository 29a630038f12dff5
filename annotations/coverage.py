"""Who has which expression: subjects against expressions, exclusions, and who the subjects are."""

from __future__ import annotations

from annotations.labels import AUTOMATIC, Label
from annotations.store import current_labels, is_person, read_labels
from express50.capture.demographics import age_counts, gender_counts, shown_counts
from express50.capture.index import read_index
from express50.capture.readers.person import read_people
from express50.contract.exclusions import exclusion_reason, included_subjects
from express50.contract.layout import Dataset


def coverage(dataset: Dataset) -> dict[str, dict]:
    """Coverage of the subjects that are not excluded.

    Returns:
        ``cells`` (subject -> expression -> ``person``, ``rule``, ``auto``, ``flagged`` or
        ``missing``), ``missing`` (subject -> expressions), ``excluded`` (subject -> reason),
        ``gender`` and ``age`` counts of five or more people, as far as captures say.
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
