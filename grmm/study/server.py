"""Serve a study to a browser on this machine and collect the answers.

``/`` gives the page, ``/trials?participant=3`` what that participant sees, ``/pictures/...`` the
pictures; ``POST /answers`` takes one answer. Nothing else of the folder can be asked for: the
assignment of methods to sides never leaves the server.
"""

from __future__ import annotations

import json
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from threading import Lock
from urllib.parse import parse_qs, urlsplit

from express50.errors import FormatError
from express50.files.text import parse_json
from grmm.study.design import trials
from grmm.study.results import append_answer, check_answer, read_answers, read_study

ANSWER_LIMIT = 4096  # bytes of one POST
PAGE = "page.html"


def make_server(out: Path, host: str = "127.0.0.1", port: int = 8000) -> ThreadingHTTPServer:
    """Bind a server that does not serve yet; call ``serve_forever``.

    Raises:
        FormatError: OUT holds no study, or the port is taken.
    """
    study = read_study(out)
    read_answers(out, study)  # report a damaged file now, not after an hour of answers
    page = resources.files("grmm.study").joinpath(PAGE).read_bytes()
    pictures = {p for e in study["examples"] for p in (e["reference"], *e["pictures"].values())}
    lock = Lock()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            url = urlsplit(self.path)
            name = url.path.removeprefix("/")
            if not name:
                self._reply(HTTPStatus.OK, "text/html; charset=utf-8", page)
            elif name == "trials":
                self._trials(parse_qs(url.query).get("participant", [""])[0])
            elif name in pictures:
                self._reply(HTTPStatus.OK, "image/png", (out / name).read_bytes())
            else:
                self._reply(HTTPStatus.NOT_FOUND, "text/plain", b"no such page\n")

        def do_POST(self) -> None:
            length = self.headers.get("Content-Length", "")
            if urlsplit(self.path).path != "/answers":
                self._reply(HTTPStatus.NOT_FOUND, "text/plain", b"no such page\n")
            elif self.headers.get("Content-Type") != "application/json":
                # Other sites' pages can post forms without asking, but not this type.
                self._reply(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "text/plain", b"expected JSON\n")
            elif not length.isdecimal() or int(length) > ANSWER_LIMIT:
                self._reply(HTTPStatus.BAD_REQUEST, "text/plain", b"too long\n")
            else:
                self._answer(self.rfile.read(int(length)))

        def _answer(self, body: bytes) -> None:
            try:
                answer = check_answer(study, parse_json(body, "answer", FormatError))
            except (ValueError, FormatError) as error:
                self._reply(HTTPStatus.BAD_REQUEST, "text/plain", f"{error}\n".encode())
                return
            with lock:
                append_answer(out, answer)
            self._reply(HTTPStatus.OK, "application/json", b"{}")

        def _trials(self, text: str) -> None:
            if not text.isdecimal() or int(text) >= study["participants"]:
                message = f"participant is {text!r}, expected 0 to {study['participants'] - 1}\n"
                self._reply(HTTPStatus.BAD_REQUEST, "text/plain", message.encode())
                return
            number = int(text)
            with lock:
                done = [a for a in read_answers(out, study) if a["participant"] == number]
            content = {
                "trials": trials(study, number),
                "questions": study["questions"],
                "done": done,
            }
            self._reply(HTTPStatus.OK, "application/json", json.dumps(content).encode())

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
