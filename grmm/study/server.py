"""Serve a study to a browser on this machine and collect the answers.

``/`` gives the page, ``/trials?participant=3`` what that participant sees, ``/pictures/...`` the
pictures; ``POST /answers`` takes one answer. Nothing else of the folder can be asked for: the
assignment of methods to sides never leaves the server.
"""

from __future__ import annotations

import json
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock
from urllib.parse import parse_qs, urlsplit

from express50.errors import FormatError
from express50.files.text import parse_json
from grmm.study import append_answer, check_answer, read_answers, read_study, trials

ANSWER_LIMIT = 4096  # bytes of one POST
PAGE = Path(__file__).with_name("page.html")
Reply = tuple[HTTPStatus, str, bytes]
NOT_FOUND: Reply = (HTTPStatus.NOT_FOUND, "text/plain", b"no such page\n")


def make_server(out: Path, host: str = "127.0.0.1", port: int = 8000) -> ThreadingHTTPServer:
    """Bind a server that does not serve yet; call ``serve_forever``.

    Raises:
        FormatError: OUT holds no study, or the port is taken.
    """
    study = StudyPages(out)

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self._reply(*study.get(self.path))

        def do_POST(self) -> None:
            length = self.headers.get("Content-Length", "")
            if urlsplit(self.path).path != "/answers":
                self._reply(*NOT_FOUND)
            elif self.headers.get("Content-Type") != "application/json":
                # Other sites' pages can post forms without asking, but not this type.
                self._reply(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "text/plain", b"expected JSON\n")
            elif not length.isdecimal() or int(length) > ANSWER_LIMIT:
                self._reply(HTTPStatus.BAD_REQUEST, "text/plain", b"too long\n")
            else:
                self._reply(*study.answer(self.rfile.read(int(length))))

        def _reply(self, status: HTTPStatus, kind: str, body: bytes) -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            """Say nothing: the answers are the log."""

    try:
        return ThreadingHTTPServer((host, port), Handler)
    except OSError as error:
        raise FormatError(f"{host}:{port} cannot be listened on: {error}; try --port") from error


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
        name = url.path.removeprefix("/")
        if not name:
            return HTTPStatus.OK, "text/html; charset=utf-8", PAGE.read_bytes()
        if name in self.pictures:
            return HTTPStatus.OK, "image/png", (self.out / name).read_bytes()
        if name != "trials":
            return NOT_FOUND
        text, count = parse_qs(url.query).get("participant", [""])[0], self.study["participants"]
        if not text.isdecimal() or int(text) >= count:
            message = f"participant is {text!r}, expected 0 to {count - 1}\n"
            return HTTPStatus.BAD_REQUEST, "text/plain", message.encode()
        number = int(text)
        with self.lock:
            answers = read_answers(self.out, self.study)
        content = {
            "trials": trials(self.study, number),
            "questions": self.study["questions"],
            "done": [answer for answer in answers if answer["participant"] == number],
        }
        return HTTPStatus.OK, "application/json", json.dumps(content).encode()

    def answer(self, body: bytes) -> Reply:
        """Check one answer and append it."""
        try:
            answer = check_answer(self.study, parse_json(body, "answer", FormatError))
        except FormatError as error:
            return HTTPStatus.BAD_REQUEST, "text/plain", f"{error}\n".encode()
        with self.lock:
            append_answer(self.out, answer)
        return HTTPStatus.OK, "application/json", b"{}"
