"""Exclusion of subjects: the last such event in a subject's label file decides."""

from __future__ import annotations

import contextlib

from express50.contract.layout import Dataset
from express50.errors import AnnotationError
from express50.files.text import parse_json, read_bytes


def exclusion_reason(dataset: Dataset, subject: str) -> str | None:
    """Return why a subject is excluded (``express50 annotate exclude``), or None if it is not."""
    path = dataset.labels_file(subject)
    reason = None
    data = read_bytes(path, AnnotationError) if path.is_file() else b""
    for line in data.decode("utf-8", errors="replace").split("\n"):
        with contextlib.suppress(AnnotationError, AttributeError):  # a torn line says nothing
            row = parse_json(line, str(path), AnnotationError)
            if row.get("action") in ("exclude", "include"):
                reason = row.get("reason") if row["action"] == "exclude" else None
    return reason


def included_subjects(dataset: Dataset) -> list[str]:
    """List ingested subjects that are not excluded, sorted."""
    return [s for s in dataset.subjects() if exclusion_reason(dataset, s) is None]
