"""Which subjects are excluded, and why: the last such event in a subject's label file decides."""

from __future__ import annotations

import contextlib
import json

from express50.layout import Dataset


def exclusion_reason(dataset: Dataset, subject: str) -> str | None:
    """Why a subject is excluded (``express50 annotate exclude``), or None when it is not."""
    path = dataset.labels_file(subject)
    reason = None
    text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
    for line in text.split("\n"):
        with contextlib.suppress(ValueError, AttributeError):  # a torn line says nothing
            row = json.loads(line)
            if row.get("action") in ("exclude", "include"):
                reason = row.get("reason") if row["action"] == "exclude" else None
    return reason


def included_subjects(dataset: Dataset) -> list[str]:
    """Ingested subjects that are not excluded, sorted."""
    return [s for s in dataset.subjects() if exclusion_reason(dataset, s) is None]
