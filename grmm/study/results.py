"""The answers of a study, and the paper's table of them with confidence intervals.

One JSON object per line; the last answer to a question counts. Judgments of one participant are
correlated, so intervals come from a bootstrap that draws whole participants with replacement (the
cluster bootstrap; Field and Welsh 2007). One participant gives no interval.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from express50.errors import FormatError
from express50.files.text import markdown_table, parse_json, read_json
from grmm.study.design import ANSWERS, FORMAT, method_of

FIELDS = ("participant", "example", "question", "answer")
DRAWS = 2000
LEVEL = 0.95
COLUMNS = ("first++", "first+", "second++", "second+", "tie")


def read_study(out: Path) -> dict:
    """Read the study that `make_study` wrote.

    Raises:
        FormatError: there is none.
    """
    path = out / "study.json"
    if not path.exists():
        raise FormatError(f"{path}: no such study; 'grmm study make' writes one")
    study = read_json(path, FormatError, "make the study again")
    if not isinstance(study, dict) or study.get("format") != FORMAT:
        raise FormatError(f"{path}: expected format {FORMAT!r}; make the study again")
    for name, kinds in (
        ("participants", (int,)),
        ("examples", (list,)),
        ("questions", (list, dict)),
    ):
        if not isinstance(study.get(name), kinds):
            raise FormatError(f"{path}: {name} is {study.get(name)!r}; make the study again")
    return study


def check_answer(study: dict, value: object) -> dict:
    """Check one answer and keep only {participant, example, question, answer}.

    Raises:
        FormatError: a field is missing or out of range.
    """
    if not isinstance(value, dict):
        raise FormatError(f"an answer is a {type(value).__name__}, expected an object")
    limits = {"participant": study["participants"], "example": len(study["examples"])}
    for name, limit in limits.items():
        number = value.get(name)
        if type(number) is not int or not 0 <= number < limit:
            raise FormatError(f"answer: {name} is {number!r}, expected 0 to {limit - 1}")
    for name, known in (("question", tuple(study["questions"])), ("answer", ANSWERS)):
        if value.get(name) not in known:
            raise FormatError(f"answer: {name} is {value.get(name)!r}, expected {', '.join(known)}")
    return {name: value[name] for name in FIELDS}


def append_answer(out: Path, answer: dict) -> None:
    """Add a checked answer to OUT/answers.jsonl; it is on the disk when this returns.

    A last line that a kill cut short goes: it was never acknowledged, the page asks again.
    """
    with (out / "answers.jsonl").open("a+b") as file:
        file.seek(0)
        content = file.read()
        file.truncate(content.rfind(b"\n") + 1)
        file.write((json.dumps(answer, sort_keys=True) + "\n").encode())
        file.flush()
        os.fsync(file.fileno())


def read_answers(out: Path, study: dict) -> list[dict]:
    """Read all answers; the last one to a question counts; a torn last line is left out.

    Raises:
        FormatError: a line is not an answer to this study.
    """
    path = out / "answers.jsonl"
    lines = path.read_bytes().splitlines() if path.exists() else []
    answers: dict[tuple, dict] = {}
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            value = parse_json(line, f"{path}, line {number}", FormatError, "remove it")
        except FormatError:
            if number == len(lines):  # killed while it was written
                continue
            raise
        try:
            answer = check_answer(study, value)
        except FormatError as error:
            raise FormatError(f"{path}, line {number}: {error}") from error
        answers[answer["participant"], answer["example"], answer["question"]] = answer
    return [answers[key] for key in sorted(answers)]


def judgments(study: dict, answers: Sequence[dict]) -> list[tuple[int, str, str]]:
    """(participant, question, column) of every answer, with sides turned back into methods."""
    first = study["methods"][0]
    found = []
    for answer in answers:
        text = answer["answer"]
        if text == "=":
            column = "tie"
        else:
            method = method_of(study, answer["participant"], answer["example"], text[0])
            column = ("first" if method == first else "second") + text[1:]
        found.append((answer["participant"], answer["question"], column))
    return found


def summarise(study: dict, answers: Sequence[dict], seed: int = 0) -> dict:
    """Summarise answers: percentages with intervals per question and overall, and their count."""
    found = judgments(study, answers)
    rows = {
        question: _row([f for f in found if f[1] == question], seed)
        for question in study["questions"]
    }
    rows["overall"] = _row(found, seed)
    people = sorted({participant for participant, _, _ in found})
    return {
        "methods": study["methods"],
        "rows": rows,
        "judgments": len(found),
        "participants": len(people),
        "judgments_expected": (
            study["participants"] * len(study["examples"]) * len(study["questions"])
        ),
        "interval": f"{LEVEL:.0%}, bootstrap over participants, {DRAWS} draws",
    }


def _row(found: Sequence[tuple[int, str, str]], seed: int) -> dict:
    """Compute the percent of every column and of each method's two, with intervals."""
    people = sorted({participant for participant, _, _ in found})
    counts = np.zeros((len(people), len(COLUMNS)))
    for participant, _, column in found:
        counts[people.index(participant), COLUMNS.index(column)] += 1
    sums = {"first": (0, 1), "second": (2, 3)}
    row: dict[str, object] = {"judgments": len(found)}
    rng = np.random.default_rng(seed)
    drawn = None
    if len(people) > 1:
        drawn = counts[rng.integers(len(people), size=(DRAWS, len(people)))].sum(1)
    for name, places in {**{c: (i,) for i, c in enumerate(COLUMNS)}, **sums}.items():
        row[name] = _share(counts.sum(0)[None], places, None)
        row[f"{name}_interval"] = _share(drawn, places, LEVEL)
    return row


def _share(counts: np.ndarray | None, places: tuple[int, ...], level: float | None) -> object:
    """Return percent of some columns; of many draws the interval that holds ``level`` of them."""
    if counts is None or not counts.sum():
        return None
    shares = 100 * counts[:, places].sum(1) / counts.sum(1)
    if level is None:
        return round(float(shares[0]), 2)
    tail = 50 * (1 - level)
    low, high = np.percentile(shares, [tail, 100 - tail])
    return [round(float(low), 2), round(float(high), 2)]


def markdown(summary: dict) -> str:
    """Format the table as the paper does: percentages, with intervals for both methods."""
    first, second = summary["methods"]
    head = [
        "Type",
        f"{first} ++",
        f"{first} +",
        f"{second} ++",
        f"{second} +",
        "Tie",
        first,
        second,
    ]
    lines = []
    for name, row in summary["rows"].items():
        cells = [_percent(row[column]) for column in COLUMNS]
        sums = [_percent(row[m], row[f"{m}_interval"]) for m in ("first", "second")]
        lines.append([name.capitalize(), *cells, *sums])
    return "\n".join(markdown_table(head, lines)) + (
        "\n"
        f"\n{summary['judgments']} of {summary['judgments_expected']} judgments by "
        f"{summary['participants']} participants; in brackets: {summary['interval']}.\n"
    )


def _percent(value: float | None, interval: Sequence[float] | None = None) -> str:
    if value is None:
        return "n/a"
    text = f"{value:.1f}%"
    return text if interval is None else f"{text} ({interval[0]:.1f} to {interval[1]:.1f})"
