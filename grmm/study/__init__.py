"""Ask people which of two methods is better, as the paper did: make a study, and its table.

A study is counterbalanced twice: A is the first method in half of the examples, and every second
participant sees the mirrored assignment. So for two participants, each example shows each method
once on each side. Every participant sees the examples in a different order.

Answers are one JSON object per line; the last answer to a question counts. Judgments of one
participant are correlated, so intervals come from a bootstrap that draws whole participants with
replacement (the cluster bootstrap; Field and Welsh 2007). One participant gives no interval.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from http import HTTPStatus
from pathlib import Path
from threading import Lock
from urllib.parse import parse_qs, urlsplit

import numpy as np

from express50.console import count
from express50.errors import ConfigError, FormatError
from express50.files.atomic import write_bytes, write_json
from express50.files.containers import read_srgb
from express50.files.images import encode_png
from express50.files.text import markdown_table, no_folder, parse_json, read_json_table
from express50.local_server import NOT_FOUND, PageServer, Reply

FORMAT = "grmm.study/1"
QUESTIONS = {
    "expression": "Which of the two keeps the expression better?",
    "identity": "Which of the two keeps the identity better?",
}
ANSWERS = ("A++", "A+", "=", "B+", "B++")
SUFFIXES = (".png", ".jpg", ".jpeg")
FIELDS = ("participant", "example", "question", "answer")
DRAWS = 2000
LEVEL = 0.95
DIGITS = 4  # of percentages; of two, 19.0476 % would be shown as 19.1 %
ANSWER_LIMIT = 4096  # bytes of one POST
PAGE = Path(__file__).with_name("page.html")
COLUMNS = ("first++", "first+", "second++", "second+", "tie")
SUMS = {name: [i] for i, name in enumerate(COLUMNS)} | {"first": [0, 1], "second": [2, 3]}


def make_study(
    out: Path,
    reference: Path,
    methods: Sequence[tuple[str, Path]],
    examples: int = 15,
    participants: int = 20,
    seed: int = 0,
) -> dict:
    """Write OUT/study.json, which holds the assignment, and OUT/pictures/.

    Pictures of one example have one name in all three folders: the reference (a frontal view of
    the truth) and the two renderings of a novel view. ``methods`` are two names and folders.
    Defaults are the paper's: 20 participants, 15 examples, two questions each.

    Raises:
        ConfigError: too few common pictures, or OUT holds answers already.
        FormatError: a picture cannot be read.
    """
    if (out / "answers.jsonl").exists():
        raise ConfigError(
            f"{out}: this study already has answers; make a new one in another folder"
        )
    (first, ours), (second, theirs) = methods
    if first == second:
        raise ConfigError(f"both methods are called {first!r}; give two names with --names")
    folders = [_pictures(folder) for folder in (reference, ours, theirs)]
    names = sorted(set.intersection(*map(set, folders)))
    if len(names) < examples:
        raise ConfigError(
            f"{reference}, {ours}, {theirs}: {len(names)} pictures are common to all three, "
            f"expected {examples}; lower --examples or render more"
        )
    rng = np.random.default_rng(seed)
    chosen = sorted(rng.choice(names, size=examples, replace=False).tolist())
    first_is_a = np.arange(examples) < (examples + int(rng.integers(2))) // 2
    rng.shuffle(first_is_a)
    entries = []
    for number, name in enumerate(chosen):
        truth, our, their = (_copy(folder[name], out, seed) for folder in folders)
        entries.append(
            {
                "example": name,
                "reference": truth,
                "pictures": {first: our, second: their},
                "A": first if first_is_a[number] else second,
            }
        )
    study = {
        "format": FORMAT,
        "methods": [first, second],
        "questions": QUESTIONS,
        "participants": participants,
        "seed": seed,
        "examples": entries,
    }
    write_json(out / "study.json", study)
    return study


def _pictures(folder: Path) -> dict[str, Path]:
    """Find the pictures of a folder by their stems."""
    if not folder.is_dir():
        raise ConfigError(
            f"{folder}: {no_folder(folder)}; expected pictures with the same names as the others"
        )
    found = sorted(folder.iterdir(), reverse=True)
    return {path.stem: path for path in found if path.suffix.lower() in SUFFIXES}


def _copy(path: Path, out: Path, seed: int) -> str:
    """Write a picture as PNG under a digest; returns that name, relative to OUT.

    The digest is of what the picture shows and where it came from. Two methods that made the same
    picture must not be recognised by a shared address either.
    """
    data = encode_png(read_srgb(path))
    digest = hashlib.sha256(f"{seed} {path.parent} {path.stem} ".encode() + data).hexdigest()[:24]
    write_bytes(out / "pictures" / f"{digest}.png", data)
    return f"pictures/{digest}.png"


def trials(study: dict, participant: int) -> list[dict]:
    """List what one participant sees, in order: example, and pictures of reference, A and B."""
    entries = study["examples"]
    order = np.random.default_rng([study["seed"], 1, participant]).permutation(len(entries))
    return [
        {"example": number, "reference": entries[number]["reference"]}
        | {
            side: entries[number]["pictures"][method_of(study, participant, number, side)]
            for side in "AB"
        }
        for number in order.tolist()
    ]


def method_of(study: dict, participant: int, example: int, side: str) -> str:
    """Return the method that a participant saw on a side; odd participants see it mirrored."""
    first, second = study["methods"]
    first_is_a = study["examples"][example]["A"] == first
    mirrored = participant % 2 == 1
    return first if first_is_a ^ mirrored ^ (side == "B") else second


def read_study(out: Path) -> dict:
    """Read the study that `make_study` wrote; FormatError if there is none."""
    path = out / "study.json"
    if not path.exists():
        raise FormatError(f"{path}: no such study; 'grmm study make' writes one")
    study = read_json_table(path, FormatError, "make the study again")
    kinds = {"participants": (int,), "examples": (list,), "questions": (list, dict)}
    wrong = [name for name, kind in kinds.items() if not isinstance(study.get(name), kind)]
    if study.get("format") != FORMAT or wrong:
        raise FormatError(
            f"{path}: format is {study.get('format')!r}, expected {FORMAT!r} with "
            f"{', '.join(kinds)}; make the study again"
        )
    try:
        first, second = study["methods"]
        whole = type(study["seed"]) is int and all(
            isinstance(example["reference"], str)
            and example["pictures"].keys() == {first, second}
            and example["A"] in (first, second)
            for example in study["examples"]
        )
    except (KeyError, TypeError, ValueError, AttributeError):
        whole = False
    if not whole:
        raise FormatError(
            f"{path}: its methods, its seed or an example are not as 'grmm study make' writes them;"
            " make the study again"
        )
    return study


def check_answer(study: dict, value: object, where: str = "answer") -> dict:
    """Check one answer and keep only {participant, example, question, answer}.

    Raises:
        FormatError: a field is missing or out of range.
    """
    if not isinstance(value, dict):
        raise FormatError(f"{where}: got a {type(value).__name__}, expected an object")
    limits = {"participant": study["participants"], "example": len(study["examples"])}
    for name, limit in limits.items():
        number = value.get(name)
        if type(number) is not int or not 0 <= number < limit:
            raise FormatError(f"{where}: {name} is {number!r}, expected 0 to {limit - 1}")
    for name, known in (("question", tuple(study["questions"])), ("answer", ANSWERS)):
        if value.get(name) not in known:
            raise FormatError(
                f"{where}: {name} is {value.get(name)!r}, expected {', '.join(known)}"
            )
    return {name: value[name] for name in FIELDS}


def append_answer(out: Path, answer: dict) -> None:
    """Add a checked answer to OUT/answers.jsonl; it is on the disk when this returns.

    A last line that a kill cut short is removed: it was never acknowledged, so the page asks again.
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
        where = f"{path}, line {number}"
        try:
            value = parse_json(line, where, FormatError, "remove it")
        except FormatError:
            if number == len(lines):  # killed while it was written
                continue
            raise
        answer = check_answer(study, value, where)
        answers[answer["participant"], answer["example"], answer["question"]] = answer
    return [answers[key] for key in sorted(answers)]


def summarise(study: dict, answers: Sequence[dict]) -> dict:
    """Summarise answers: percentages with intervals per question and overall, and their count."""
    rows = {
        question: _row(study, [a for a in answers if a["question"] == question])
        for question in study["questions"]
    }
    rows["overall"] = _row(study, answers)
    return {
        "methods": study["methods"],
        "rows": rows,
        "judgments": len(answers),
        "participants": len({answer["participant"] for answer in answers}),
        "judgments_expected": (
            study["participants"] * len(study["examples"]) * len(study["questions"])
        ),
        "interval": f"{LEVEL:.0%}, bootstrap over participants, {DRAWS} draws",
    }


def _row(study: dict, answers: Sequence[dict]) -> dict:
    """Compute the percent of every column and of each method's two, with intervals."""
    people = sorted({answer["participant"] for answer in answers})
    counts = np.zeros((len(people), len(COLUMNS)))
    for answer in answers:
        side, participant, column = answer["answer"], answer["participant"], "tie"
        if side != "=":  # the side back into a method
            method = method_of(study, participant, answer["example"], side[0])
            column = ("first" if method == study["methods"][0] else "second") + side[1:]
        counts[people.index(participant), COLUMNS.index(column)] += 1
    draws = np.random.default_rng(0).integers(max(1, len(people)), size=(DRAWS, len(people)))
    row: dict[str, object] = {"judgments": len(answers)}
    for name, places in SUMS.items():
        row[name] = row[f"{name}_interval"] = None
        if people:
            row[name] = round(float(_percent_of(counts.sum(0)[None], places)[0]), DIGITS)
        if len(people) > 1:
            tail = 50 * (1 - LEVEL)
            ends = np.percentile(_percent_of(counts[draws].sum(1), places), [tail, 100 - tail])
            row[f"{name}_interval"] = [round(float(end), DIGITS) for end in ends]
    return row


def _percent_of(counts: np.ndarray, places: list[int]) -> np.ndarray:
    return 100 * counts[:, places].sum(1) / counts.sum(1)


def markdown(summary: dict) -> str:
    """Format the table as the paper does: percentages, with intervals for both methods."""
    methods = summary["methods"]
    signed = [f"{name} {sign}" for name in methods for sign in ("++", "+")]
    lines = []
    for name, row in summary["rows"].items():
        cells = [_percent(row[column]) for column in COLUMNS]
        sums = [_percent(row[m], row[f"{m}_interval"]) for m in ("first", "second")]
        lines.append([name.capitalize(), *cells, *sums])
    return "\n".join(markdown_table(["Type", *signed, "Tie", *methods], lines)) + (
        "\n"
        f"\n{summary['judgments']} of {summary['judgments_expected']} judgments by "
        f"{count(summary['participants'], 'participant')}; in brackets: {summary['interval']}.\n"
    )


def _percent(value: float | None, interval: Sequence[float] | None = None) -> str:
    if value is None:
        return "n/a"
    text = f"{value:.1f}%"
    return text if interval is None else f"{text} ({interval[0]:.1f} to {interval[1]:.1f})"


def make_server(out: Path, host: str = "127.0.0.1", port: int = 8000) -> PageServer:
    """Bind a server that does not serve yet; call ``serve_forever``.

    Its address gives the page, ``trials?participant=3&session=...`` below it what that participant
    sees, ``pictures/...`` the pictures; ``POST answers`` takes one answer. Nothing else of the
    folder can be asked for: the assignment of methods to sides never leaves the server.

    A session is one opened page. A number belongs to the first that asks for it; another one takes
    it over with ``&continue=yes`` alone, so that two people do not overwrite each other's answers.

    Raises:
        FormatError: OUT holds no study.
        ConfigError: the port is taken.
    """
    study = StudyPages(out)
    return PageServer(study.get, study.post, host, port)


class StudyPages:
    """What the server shows and takes; answers are read and written by one thread at a time."""

    def __init__(self, out: Path) -> None:
        """Read the study; a damaged file is reported now, not after an hour of answers."""
        self.out, self.study, self.lock = out, read_study(out), Lock()
        self.sessions: dict[int, str] = {}  # of each participant
        read_answers(out, self.study)
        examples = self.study["examples"]
        self.pictures = {p for e in examples for p in (e["reference"], *e["pictures"].values())}

    def get(self, address: str) -> Reply:
        """Return the page, a picture, or what one participant sees."""
        url = urlsplit(address)
        name = url.path
        if not name:
            return Reply(HTTPStatus.OK, "text/html; charset=utf-8", PAGE.read_bytes())
        if name in self.pictures:
            return Reply(HTTPStatus.OK, "image/png", (self.out / name).read_bytes())
        if name != "trials":
            return NOT_FOUND
        asked = {name: values[0] for name, values in parse_qs(url.query).items()}
        text, session = asked.get("participant", ""), asked.get("session", "")
        limit = self.study["participants"]
        if not text.isdecimal() or len(text) > 9 or int(text) >= limit:
            return _refusal(
                HTTPStatus.BAD_REQUEST, f"participant is {text[:9]!r}, expected 0 to {limit - 1}"
            )
        return self.begin(int(text), session, continued="continue" in asked)

    def begin(self, number: int, session: str, continued: bool) -> Reply:
        """Return what one participant sees, unless another session has this number."""
        with self.lock:
            answers = read_answers(self.out, self.study)
            done = [answer for answer in answers if answer["participant"] == number]
            # Whoever answered before the server started can only be asked.
            free = self.sessions.get(number, None if done else session) == session
            if not free and not continued:
                return _refusal(
                    HTTPStatus.CONFLICT,
                    f"Somebody has begun as number {number} and given {count(len(done), 'answer')}."
                    " Continue only if this was you; otherwise cancel, and enter another number.",
                )
            self.sessions[number] = session
        content = {
            "trials": trials(self.study, number),
            "questions": self.study["questions"],
            "done": done,
        }
        return Reply(HTTPStatus.OK, "application/json", json.dumps(content).encode())

    def post(self, address: str, kind: str, body: Callable[[int], bytes | None]) -> Reply:
        """Check one answer and append it."""
        if address != "answers":
            return NOT_FOUND
        if kind != "application/json":
            # Other sites' pages can post forms without asking, but not this type.
            return _refusal(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "expected JSON")
        content = body(ANSWER_LIMIT)
        if content is None:
            return _refusal(HTTPStatus.BAD_REQUEST, "too long")
        try:
            value = parse_json(content, "answer", FormatError)
            answer = check_answer(self.study, value)
        except FormatError as error:
            return _refusal(HTTPStatus.BAD_REQUEST, str(error))
        number, session = answer["participant"], value.get("session", "")
        with self.lock:
            if self.sessions.setdefault(number, session) != session:
                words = f"Number {number} is used on another page; reload this one to begin."
                return _refusal(HTTPStatus.CONFLICT, words)
            append_answer(self.out, answer)
        return Reply(HTTPStatus.OK, "application/json", b"{}")


def _refusal(status: HTTPStatus, words: str) -> Reply:
    return Reply(status, "text/plain", f"{words}\n".encode())
