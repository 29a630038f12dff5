"""Import labels from elsewhere: CSV or JSON files, and RenderMe-360's rule.

A file holds every event; importing it neither loses nor duplicates any. The 12 expressions of
RenderMe-360 are recorded so that the performer holds the target at the end of the clip. The
dataset's users take the last frame (RenderMe-360's processing tools). Its releases end at different
frames, so ingest stores which release was read and the number of its last frame, and a label
repeats them. A rule's label ranks below any person's and above a suggestion.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Collection, Iterable
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from annotations.labels import (
    ACTIONS,
    EXCLUSION_ACTIONS,
    KINDS,
    REQUIRED,
    RULE_PREFIX,
    Label,
    append_label,
    check_texts,
    current_labels,
    lost_frame,
    make_mark,
    read_labels,
)
from express50.capture.index import UNKNOWN_HASH, Index, read_index
from express50.console import count
from express50.contract.layout import Dataset
from express50.errors import AnnotationError, check_known
from express50.files.atomic import write_bytes
from express50.files.text import NAME, csv_table, parse_json, read_text, refusing

LARGEST = 2**63
ROUNDED_S = 0.5  # by which a spreadsheet that shows whole seconds changes a time
_FORMULA = re.compile(r"'*[=+\-@\t\r]")  # quotes before it too, so that reading is exact
_HASH = re.compile(f"[0-9a-f]{{16}}|{UNKNOWN_HASH}")
_AS_TEXT = "; a spreadsheet changed it: export again, and open that column as text"
_FIELDS = tuple(field.name for field in fields(Label))


def export_labels(labels: Iterable[Label], path: Path, stored: Collection[Label] = ()) -> None:
    """Write events as CSV or JSON, by the file's ending.

    Raises:
        AnnotationError: another ending; or the file exists and holds anything but ``stored``
            events, such as those that somebody meant to import.
    """
    _check_format(path)
    if path.exists():
        try:
            new = set(read_table(path)) - set(stored)
        except AnnotationError:
            raise AnnotationError(f"{path}: is not a table of labels; name another file") from None
        if new:
            raise AnnotationError(
                f"{path}: holds {count(len(new), 'event')} that the dataset does not have; add"
                " them with 'express50 annotate import', or name another file"
            )
    rows = [asdict(label) for label in labels]
    path.parent.mkdir(parents=True, exist_ok=True)
    text = io.StringIO(newline="")
    if path.suffix.lower() == ".json":
        rows = [{k: v for k, v in row.items() if v is not None} for row in rows]
        text.write(json.dumps(rows, indent=1, sort_keys=True) + "\n")
    else:
        writer = csv.DictWriter(text, _FIELDS)
        writer.writeheader()
        # Spreadsheets run a cell that begins like a formula; a quote before it makes it text.
        for row in rows:
            writer.writerow({k: f"'{v}" if _FORMULA.match(str(v)) else v for k, v in row.items()})
    write_bytes(path, text.getvalue().encode())


def import_labels(dataset: Dataset, path: Path) -> tuple[int, int]:
    """Append the events of a file that the store does not hold yet; return (new, known).

    Everything is checked before anything is written.

    Raises:
        AnnotationError: a row is not an event, or names an unknown subject, or a frame that the
            footage does not have or that shows another picture.
    """
    labels = read_table(path)
    for number, label in enumerate(labels, 1):
        where = f"{path}: row {number}"
        check_known(where, "subject", [label.subject], dataset.subjects(), AnnotationError)
        index = read_index(dataset, label.subject)
        named = [label.expression] if label.expression else []  # an exclusion names none
        cues = [cue.expression_id for cue in index.cues]
        check_known(where, "expression", named, cues, AnnotationError)
        check_texts(label)
        if what := lost_frame(index, label):
            raise AnnotationError(f"{where}: {what}; was it made on other footage?")
    held = [label for s in {x.subject for x in labels} for label in read_labels(dataset, s)]
    new = _unknown(list(dict.fromkeys(labels)), held)
    for label in new:
        append_label(dataset, label, imported=True)
    return len(new), len(labels) - len(new)


def _unknown(labels: list[Label], held: Iterable[Label]) -> list[Label]:
    """Return the labels that are not held, even with numbers as a spreadsheet rounds them.

    Added again, an old label would come after what its annotator has said since.
    """

    def words(label: Label) -> Label:
        return replace(label, time=0.0, confidence=None, seconds=None)

    times: dict[Label, list[float]] = {}
    for label in held:
        times.setdefault(words(label), []).append(label.time)
    return [
        label
        for label in labels
        if all(abs(time - label.time) > ROUNDED_S for time in times.get(words(label), ()))
    ]


def read_table(path: Path) -> list[Label]:
    """Read the events of a CSV or JSON file; AnnotationError if it cannot be read as events."""
    _check_format(path)
    is_json = path.suffix.lower() == ".json"
    text = read_text(path, AnnotationError)
    if is_json:
        rows = parse_json(text, str(path), AnnotationError)
        if not isinstance(rows, list):
            raise AnnotationError(f"{path}: expected a list of events, got {type(rows).__name__}")
    else:
        table = csv_table(text)
        rows = (
            {k: v.removeprefix("'") if _FORMULA.match(str(v)) else v for k, v in row.items()}
            for row in table
        )
    with refusing(AnnotationError, f"{path}: not CSV", "export it again", (csv.Error,)):
        labels = [
            _label(row, f"{path}: row {number}")
            for number, row in enumerate(rows, 1)
            if is_json or any(row.values())  # spreadsheets write rows of empty cells
        ]
    if not is_json and not labels and set(REQUIRED) - set(table.fieldnames or REQUIRED):
        raise AnnotationError(f"{path}: not a table of labels, which have {', '.join(REQUIRED)}")
    return labels


def _check_format(path: Path) -> None:
    if path.suffix.lower() not in (".csv", ".json"):
        raise AnnotationError(f"{path}: ends in {path.suffix!r}, expected .csv or .json")


def _label(row: object, where: str) -> Label:
    if not isinstance(row, dict):
        raise AnnotationError(f"{where}: expected an object, got {type(row).__name__}")
    given = {k: v for k, v in row.items() if v not in (None, "")}
    if given.get("action") in EXCLUSION_ACTIONS:
        given.setdefault("expression", "")
    unknown = sorted(set(map(str, given)) - set(_FIELDS))
    missing = sorted(set(REQUIRED) - set(given))
    if unknown or missing:
        said = [f"no {name}" for name in missing] + [f"unknown column {name!r}" for name in unknown]
        raise AnnotationError(
            f"{where}: {', '.join(said)}; expected columns as 'express50 annotate export' writes"
            f" them, at least {', '.join(REQUIRED)}"
        )
    if not NAME.fullmatch(str(given["subject"])):  # it becomes a file name
        raise AnnotationError(f"{where}: subject {given['subject']!r} is not an id")
    check_known(where, "action", [given["action"]], ACTIONS, AnnotationError)
    framed = given["action"] == "mark" or (given["action"] == "settle" and "reason" not in given)
    needed = {"frame", "camera", "dhash"} if framed else set()
    needed |= {"reason"} if given["action"] == "flag" else set()
    if lacking := sorted(needed - set(given)):
        fix = "; 'express50 annotate mark' labels a frame by its number" if framed else ""
        raise AnnotationError(f"{where}: a {given['action']} needs {', '.join(lacking)}{fix}")
    try:
        return Label(**{k: _typed(k, v) for k, v in given.items()})
    except ValueError as error:
        raise AnnotationError(f"{where}: {error}") from None


def _typed(name: str, value: object) -> Any:
    """Convert a cell to its column's type; CSV holds text only."""
    kind, text = KINDS[name], str(value)
    if kind == bool | None:
        if text.lower() not in ("true", "false"):  # spreadsheets write TRUE
            raise ValueError(f"{name} is {text}, expected True or False")
        return text.lower() == "true"
    if name == "dhash" and not _HASH.fullmatch(text):
        raise ValueError(f"{name} is {text[:40]!r}, expected 16 hexadecimal digits{_AS_TEXT}")
    if kind in (str, str | None):
        return text
    if name == "time" and "e" in text.lower():  # 1.8E+09 may lie in the future
        raise ValueError(f"{name} is {text[:40]!r}, expected all of its digits{_AS_TEXT}")
    try:
        number = int(text) if kind == int | None else float(text.replace(",", "."))
    except ValueError:
        wanted = "whole number" if kind == int | None else "number"
        raise ValueError(f"{name} is {text[:40]!r}, expected a {wanted}") from None
    if not abs(number) < LARGEST:  # refuses NaN too
        raise ValueError(f"{name} is {text[:40]}, expected a number under 2^63")
    return number


LAST_FRAME = RULE_PREFIX + "last-frame"
RENDERME360_EXPRESSIONS = frozenset(f"e{n:0{width}}" for n in range(12) for width in (1, 2))


def last_frame_marks(
    dataset: Dataset, index: Index, expressions: Collection[str] | None = None
) -> list[Label]:
    """Make the rule's new marks for a subject; none if it made the same marks before.

    Without given expressions the rule covers RenderMe-360's: those that ingest read out of its
    files, else those with ids e0 (or e00) to e11.

    Raises:
        AnnotationError: a clip's last frame is not the last of the performance.
    """
    facts = index.meta.get("renderme360", {})
    if expressions is None:
        expressions = [e for e, row in facts.items() if str(row["performance"]).startswith("e")]
        expressions = expressions or RENDERME360_EXPRESSIONS
    labels = read_labels(dataset, index.subject)
    said = current_labels(x for x in labels if x.annotator == LAST_FRAME)
    camera, source = next(iter(index.cameras.items()))
    marks = []
    for cue in (cue for cue in index.cues if cue.expression_id in expressions):
        name, frame = cue.expression_id, min(cue.end_frame, source.frames - 1)
        if frame < cue.start_frame or (name in said and said[name].frame == frame):
            continue
        mark = make_mark(index, name, frame, camera, LAST_FRAME)
        if row := facts.get(name):
            if mark.pts != row["last_frame"]:
                raise AnnotationError(
                    f"{mark.subject} {name}: the clip ends with frame {mark.pts}, the performance"
                    f" with {row['last_frame']}; run 'express50 ingest' again"
                )
            reason = f"{row['release']} release, frame {row['last_frame']} of {row['num_frame']}"
            mark = replace(mark, reason=reason)
        marks.append(mark)
    return marks
