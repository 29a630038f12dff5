"""Suggestions as align writes them, for the painted footage of the fixtures."""

import json

import numpy as np

EXPRESSIONS = ("neutral", "smile", "jaw_open")
FRAMES_EACH = 16


def suggest(dataset, table):
    """Write suggestions: {subject: {expression: [frame, other candidates ...]}}."""
    for subject, rows in table.items():
        folder = dataset.item_dir("align", subject)
        folder.mkdir(parents=True, exist_ok=True)
        content = {e: suggestion_row(e, frames) for e, frames in rows.items()}
        (folder / "suggestions.json").write_text(json.dumps(content))


def suggestion_row(expression, frames):
    start = EXPRESSIONS.index(expression) * FRAMES_EACH
    numbers = np.arange(start, start + FRAMES_EACH)
    curve = np.exp(-(((numbers - frames[0]) / 3.0) ** 2)).round(3).tolist()
    return {
        "frame": frames[0], "confidence": 0.9, "start": start, "activity": curve,
        "candidates": frames, "match": curve, "kind": "match", "camera": "cam01",
        "reference": {"subject": "S001", "frame": 4, "camera": "cam01"},
    }  # fmt: skip
