"""Labels from elsewhere: CSV or JSON files, and RenderMe-360's rule.

A file holds every event, and importing it neither loses nor doubles one. The 12 expressions of
RenderMe-360 are recorded so that the performer holds the target at the end of the clip; the
dataset's users take the last frame (RenderMe-360's processing tools). That is another frame in each
of its releases, so ingest stores which release was read and the number of its last frame, and a
label says so. A rule's label stands below any person's and above a suggestion.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import MISSING, asdict, fields, replace
from pathlib import Path
from typing import Any, get_type_hints

from annotations.labels import ACTIONS, RULE_PREFIX, Label, check_texts, find_cue, make_mark
from annotations.store import append_label, current_labels, read_labels
from express50.capture.index import Cue, Index, read_index
from express50.contract.layout import Dataset
from express50.errors import AnnotationError
from express50.files.text import NAME, parse_json, read_text

FORMATS = (".csv", ".json")
LARGEST = 2**63
_FIELDS = tuple(field.name for field in fields(Label))
_REQUIRED = tuple(field.name for field in fields(Label) if field.default is MISSING)


def export_labels(labels: Iterable[Label], path: Path) -> int:
    """Write events as CSV or JSON, by the file's ending; returns how many.

    Raises:
        AnnotationError: another ending.
    """
    check_format(path)
    rows = [asdict(label) for label in labels]
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".json":
        rows = [{k: v for k, v in row.items() if v is not None} for row in rows]
        path.write_text(json.dumps(rows, indent=1, sort_keys=True) + "\n", encoding="utf-8")
        return len(rows)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, _FIELDS)
        writer.writeheader()
        writer.writerows(rows)
    return len(rows)


def import_labels(dataset: Dataset, path: Path) -> tuple[int, int]:
    """Append the events of a file that the store does not hold yet; returns (new, known).

    Everything is checked before anything is written.

    Raises:
        AnnotationError: a row is not an event, or names an unknown subject, or a frame that the
            footage does not have or whose hash differs.
    """
    labels = read_table(path)
    known: dict[str, set[Label]] = {}
    for number, label in enumerate(labels, 1):
        _check_footage(dataset, label, f"{path}: row {number}")
        if label.subject not in known:
            known[label.subject] = set(read_labels(dataset, label.subject))
    new = [label for label in dict.fromkeys(labels) if label not in known[label.subject]]
    for label in new:
        check_texts(label)
    for label in new:
        append_label(dataset, label)
    return len(new), len(labels) - len(new)


def read_table(path: Path) -> list[Label]:
    """Read the events of a CSV or JSON file.

    Raises:
        AnnotationError: the file cannot be read, or a row is not an event.
    """
    check_format(path)
    text = read_text(path, AnnotationError)
    if path.suffix == ".json":
        rows = parse_json(text, str(path), AnnotationError)
        if not isinstance(rows, list):
            raise AnnotationError(f"{path}: expected a list of events, got {type(rows).__name__}")
    else:
        rows = csv.DictReader(io.StringIO(text, newline=""))
    try:
        return [_label(row, f"{path}: row {number}") for number, row in enumerate(rows, 1)]
    except csv.Error as error:
        raise AnnotationError(f"{path}: not CSV ({error}); export it again") from None


def check_format(path: Path) -> None:
    """Refuse another ending than .csv or .json.

    Raises:
        AnnotationError: it is another.
    """
    if path.suffix not in FORMATS:
        raise AnnotationError(f"{path}: ends in {path.suffix!r}, expected .csv or .json")


def _label(row: object, where: str) -> Label:
    if not isinstance(row, dict):
        raise AnnotationError(f"{where}: expected an object, got {type(row).__name__}")
    given = {k: v for k, v in row.items() if v not in (None, "")}
    given.setdefault("expression", "")  # an exclusion is about no expression
    unknown = sorted(set(map(str, given)) - set(_FIELDS))
    missing = sorted(set(_REQUIRED) - set(given))
    if unknown or missing:
        raise AnnotationError(f"{where}: unknown columns {unknown}, missing {missing}")
    if not NAME.fullmatch(str(given["subject"])):  # it becomes the name of a file
        raise AnnotationError(f"{where}: subject {given['subject']!r} is not an id")
    if given["action"] not in ACTIONS:
        raise AnnotationError(
            f"{where}: action {given['action']!r}, expected one of {', '.join(ACTIONS)}"
        )
    framed = given["action"] == "mark" or (given["action"] == "settle" and "reason" not in given)
    needed = {"frame", "camera", "dhash"} if framed else set()
    needed |= {"reason"} if given["action"] == "flag" else set()
    if lacking := sorted(needed - set(given)):
        raise AnnotationError(f"{where}: a {given['action']} without {', '.join(lacking)}")
    try:
        return Label(**{k: _typed(k, v) for k, v in given.items()})
    except ValueError as error:
        raise AnnotationError(f"{where}: {error}") from None


def _typed(name: str, value: object) -> Any:
    """Convert a cell to its column's type; CSV holds text only."""
    kind = get_type_hints(Label)[name]
    if kind == bool | None:
        if str(value) not in ("True", "False"):
            raise ValueError(f"{name} is {value!r}, expected True or False")
        return str(value) == "True"
    for number in (int, float):
        if kind in (number, number | None):
            found = number(str(value))
            if not abs(found) < LARGEST:  # refuses NaN too
                raise ValueError(f"{name} is {str(value)[:40]}, expected a number under 2^63")
            return found
    return str(value)


def _check_footage(dataset: Dataset, label: Label, where: str) -> None:
    """Refuse an event about footage that this dataset does not have."""
    if label.subject not in dataset.subjects():
        raise AnnotationError(
            f"{where}: no subject {label.subject!r}; expected one of"
            f" {', '.join(dataset.subjects())}"
        )
    index = read_index(dataset, label.subject)
    if label.expression:
        try:
            find_cue(index, label.expression)
        except AnnotationError as error:
            raise AnnotationError(f"{where}: {error}") from None
    if label.frame is None:
        return
    source = index.cameras.get(label.camera or "")
    found = source.dhash[label.frame] if source and 0 <= label.frame < source.frames else "none"
    if found != label.dhash:
        raise AnnotationError(
            f"{where}: frame {label.frame} of {label.camera} has hash {found}, the label says"
            f" {label.dhash}; it was made on other footage"
        )


LAST_FRAME = RULE_PREFIX + "last-frame"
RENDERME360_EXPRESSIONS = frozenset(f"e{n:0{width}}" for n in range(12) for width in (1, 2))


def ruled_cues(index: Index, expressions: Sequence[str] | None = None) -> list[Cue]:
    """List the cues that the rule covers: RenderMe-360's expressions, or those named.

    They are the ones that ingest read out of its files, else those with ids e0 (or e00) to e11.
    """
    recorded = [
        name
        for name, row in _release_facts(index).items()
        if str(row["performance"]).startswith("e")
    ]
    wanted = (recorded or RENDERME360_EXPRESSIONS) if expressions is None else expressions
    return [cue for cue in index.cues if cue.expression_id in wanted]


def last_frame_marks(
    dataset: Dataset, index: Index, expressions: Sequence[str] | None = None
) -> list[Label]:
    """Make the rule's new marks of a subject; none where it made the same marks before."""
    labels = read_labels(dataset, index.subject)
    said = current_labels(x for x in labels if x.annotator == LAST_FRAME)
    camera, source = next(iter(index.cameras.items()))
    marks = []
    for cue in ruled_cues(index, expressions):
        frame = min(cue.end_frame, source.frames - 1)
        known = said.get(cue.expression_id)
        if frame >= cue.start_frame and (known is None or known.frame != frame):
            mark = make_mark(index, cue.expression_id, frame, camera, LAST_FRAME)
            row = _release_facts(index).get(cue.expression_id)
            marks.append(mark if row is None else _with_release(mark, row))
    return marks


def _release_facts(index: Index) -> dict[str, dict]:
    """Return the facts that ingest recorded about RenderMe-360's clips; empty for others."""
    return index.meta.get("renderme360", {})


def _with_release(mark: Label, row: dict) -> Label:
    """Add the release on which a mark was made.

    Raises:
        AnnotationError: the clip's last frame is not the last of the performance.
    """
    if mark.pts != row["last_frame"]:
        raise AnnotationError(
            f"{mark.subject} {mark.expression}: the clip ends with frame {mark.pts}, the "
            f"performance with {row['last_frame']}; run 'express50 ingest' again"
        )
    reason = f"{row['release']} release, frame {row['last_frame']} of {row['num_frame']}"
    return replace(mark, reason=reason)
