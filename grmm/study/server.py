"""Serve a study to a browser on this machine and collect the answers.

The server's address gives the page, ``trials?participant=3`` below it what that participant sees,
``pictures/...`` the pictures; ``POST answers`` takes one answer. Nothing else of the folder can be
asked for: the assignment of methods to sides never leaves the server.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from threading import Lock
from urllib.parse import parse_qs, urlsplit

from express50.errors import FormatError
from express50.files.text import parse_json
from express50.local_server import NOT_FOUND, PageServer, Reply
from grmm.study import append_answer, check_answer, read_answers, read_study, trials

ANSWER_LIMIT = 4096  # bytes of one POST
PAGE = Path(__file__).with_name("page.html")


def make_server(out: Path, host: str = "127.0.0.1", port: int = 8000) -> PageServer:
    """Bind a server that does not serve yet; call ``serve_forever``.

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
        text, count = parse_qs(url.query).get("participant", [""])[0], self.study["participants"]
        if not text.isdecimal() or int(text) >= count:
            message = f"participant is {text!r}, expected 0 to {count - 1}\n"
            return Reply(HTTPStatus.BAD_REQUEST, "text/plain", message.encode())
        number = int(text)
        with self.lock:
            answers = read_answers(self.out, self.study)
        content = {
            "trials": trials(self.study, number),
            "questions": self.study["questions"],
            "done": [answer for answer in answers if answer["participant"] == number],
        }
        return Reply(HTTPStatus.OK, "application/json", json.dumps(content).encode())

    def post(self, address: str, kind: str, body: Callable[[int], bytes | None]) -> Reply:
        """Check one answer and append it."""
        if address != "answers":
            return NOT_FOUND
        if kind != "application/json":
            # Other sites' pages can post forms without asking, but not this type.
            return Reply(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "text/plain", b"expected JSON\n")
        content = body(ANSWER_LIMIT)
        if content is None:
            return Reply(HTTPStatus.BAD_REQUEST, "text/plain", b"too long\n")
        try:
            answer = check_answer(self.study, parse_json(content, "answer", FormatError))
        except FormatError as error:
            return Reply(HTTPStatus.BAD_REQUEST, "text/plain", f"{error}\n".encode())
        with self.lock:
            append_answer(self.out, answer)
        return Reply(HTTPStatus.OK, "application/json", b"{}")
