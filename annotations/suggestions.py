"""What the align stage suggested for a subject, as people, matching and reports read it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from express50.contract.layout import Dataset
from express50.errors import FormatError
from express50.files.text import read_json_table


@dataclass(frozen=True, kw_only=True)
class Suggested:
    """The suggestion for one expression of one subject.

    Attributes:
        frame: the suggested frame.
        confidence: probability that it is at most one frame off, 0 to 1.
        start: frame of the curves' first value.
        activity: how far the face is from rest, one value a frame of the cue window.
        candidates: frames worth a look, best first, at least three frames apart.
        match: similarity to the reference's canonical frame, 0 to 1 a frame; None for the
            reference itself and where it has no canonical frame.
        kind: ``match`` where the reference decided, else ``peak``.
        reference: ``subject``, ``frame`` and ``camera`` of the canonical frame, or None.
        camera: the camera that sees the face best.
    """

    frame: int
    confidence: float
    start: int
    activity: list[float]
    candidates: list[int]
    match: list[float] | None = None
    kind: str = "peak"
    reference: dict[str, Any] | None = None
    camera: str = ""


def read_suggestions(dataset: Dataset, subject: str) -> dict[str, Suggested]:
    """Suggestions by expression; none when the align stage has not run.

    Raises:
        FormatError: the file is not a table of suggestions, or a figure in it is no number.
    """
    path = dataset.item_dir("align", subject) / "suggestions.json"
    if not path.is_file():
        return {}
    try:
        rows = read_json_table(path, FormatError, "run 'express50 align' again")
        return {expression: _checked(expression, row) for expression, row in rows.items()}
    except (ValueError, TypeError, AttributeError, OverflowError) as error:
        raise FormatError(
            f"{path}: not a table of suggestions ({error}); run 'express50 align' again"
        ) from None


def _checked(expression: str, row: dict[str, Any]) -> Suggested:
    """A row whose figures can be compared; one that is NaN would upset every order."""
    found = Suggested(**row)
    if not all(type(n) is int for n in (found.frame, found.start, *found.candidates)):
        raise ValueError(f"{expression}: frames are no whole numbers")
    if not 0.0 <= found.confidence <= 1.0:
        raise ValueError(f"{expression}: confidence is {found.confidence}, expected 0 to 1")
    if not all(map(math.isfinite, [*found.activity, *(found.match or ())])):
        raise ValueError(f"{expression}: its curves hold NaN or infinity")
    return found
