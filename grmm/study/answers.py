"""Answers of a study: checked when they come in, one JSON object a line, the last one counts."""

from __future__ import annotations

import json
import os
from pathlib import Path

from express50.errors import FormatError
from express50.files.text import parse_json, read_json
from grmm.study.design import ANSWERS, FORMAT

FIELDS = ("participant", "example", "question", "answer")


def read_study(out: Path) -> dict:
    """The study that `make_study` wrote.

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
    """One answer {participant, example, question, answer}, nothing else kept.

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
    """All answers; of several to one question the last; a torn last line is left out.

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
