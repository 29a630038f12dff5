"""Serve pages to browsers on this machine only.

Every address begins with a random token, so that neither another user of the machine nor a web page
can guess it. Requests that name another host (DNS rebinding) or come from another site's page are
refused, slow requests are cut off, and the number of simultaneous ones is limited.
"""

from __future__ import annotations

import secrets
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socket import (
    AF_INET,
    AF_INET6,
    SHUT_RDWR,
    SO_REUSEADDR,
    SOCK_STREAM,
    SOL_SOCKET,
    getaddrinfo,
    socket,
)
from threading import BoundedSemaphore, Timer
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from express50.console import log
from express50.errors import ConfigError

LOOPBACK = ("127.0.0.1", "localhost", "::1")
AT_ONCE = 32  # connections; more are closed unanswered
LONGEST_S = 20.0  # one request and its answer


class Reply(NamedTuple):
    """The answer to one request: its status, media type and body."""

    status: HTTPStatus
    kind: str
    body: bytes


NOT_FOUND = Reply(HTTPStatus.NOT_FOUND, "text/plain", b"no such page\n")
Get = Callable[[str], Reply]
"""The address after the token, without its slash, to its reply."""
Post = Callable[[str, str, Callable[[int], bytes | None]], Reply]
"""The address, the media type, and a function that reads a body up to a number of bytes."""


@dataclass(frozen=True)
class RequestGuard:
    """Decides who may ask a server that listens on ``host``."""

    host: str
    token: str = field(default_factory=lambda: secrets.token_urlsafe(16))

    def address(self, port: int) -> str:
        """Return the address to open in a browser."""
        host = f"[{self.host}]" if ":" in self.host else self.host  # IPv6
        return f"http://{host}:{port}/{self.token}/"

    def refusal(self, host: str | None, origin: str | None) -> str | None:
        """Return why a request with these headers is refused, or None."""
        name = urlsplit(f"//{host or ''}").hostname
        if self.host in LOOPBACK and name not in LOOPBACK:
            return "this server only answers requests to its own address\n"
        if origin is not None and origin != f"http://{host}":
            return "this server does not answer requests from other sites' pages\n"
        return None

    def path_after_token(self, path: str) -> str | None:
        """Return the path after the token and its slash; None without the token."""
        before, slash, after = path.removeprefix("/").partition("/")
        mine = secrets.compare_digest(before.encode(), self.token.encode())
        return after if mine and slash else None


def check_address(host: str, port: int) -> None:
    """Check that a server can listen on this address and port.

    Raises:
        ConfigError: the address is not this machine's, or the port is taken or not allowed.
    """
    if not 0 <= port <= 65535:
        raise ConfigError(f"port {port}: expected 0 to 65535 (0: any free port)")
    own = "expected an address of this machine, such as 127.0.0.1, or 0.0.0.0 for all of its"
    checks = ((host, 0, f"{own} addresses"), (f"{host}:{port}", port, "choose another port"))
    for where, number, fix in checks:
        try:
            family, kind, _, _, address = getaddrinfo(host, number, type=SOCK_STREAM)[0]
            with socket(family, kind) as probe:
                probe.setsockopt(SOL_SOCKET, SO_REUSEADDR, 1)  # as the server itself does
                probe.bind(address)
        except OSError as error:
            raise ConfigError(f"{where}: {error.strerror or error}; {fix}") from error


class PageServer(ThreadingHTTPServer):
    """Serves a few pages; ``serve_forever`` answers until Ctrl-C."""

    daemon_threads = True

    def __init__(self, get: Get, post: Post | None, host: str, port: int) -> None:
        """Bind the port without serving yet; ConfigError if address or port cannot be used."""
        check_address(host, port)
        self.guard, self.get, self.post = RequestGuard(host), get, post
        self._free = BoundedSemaphore(AT_ONCE)
        self.address_family = AF_INET6 if ":" in host else AF_INET
        super().__init__((host, port), _Handler)

    def serve_forever(self, poll_interval: float = 0.5) -> None:
        """Answer until Ctrl-C, the usual way to stop a server."""
        with suppress(KeyboardInterrupt):
            super().serve_forever(poll_interval)

    @property
    def address(self) -> str:
        """Return the address to open in a browser."""
        return self.guard.address(self.server_port)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread, if one is free."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer one request, in at most `LONGEST_S`."""

        def cut_off() -> None:
            with suppress(OSError):  # closed already
                request.shutdown(SHUT_RDWR)

        limit = Timer(LONGEST_S, cut_off)
        limit.daemon = True
        limit.start()
        try:
            super().process_request_thread(request, client_address)
        finally:
            limit.cancel()
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log one line on what went wrong, unless the browser was too slow or has gone."""
        error = sys.exc_info()[1]
        if not isinstance(error, ConnectionError | TimeoutError):
            log(f"a request failed: {type(error).__name__}: {error}")


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    timeout = LONGEST_S / 2  # without a byte

    def do_GET(self) -> None:  # noqa: N802
        self._answer(self.server.get)

    def do_POST(self) -> None:  # noqa: N802
        post, kind = self.server.post, self.headers.get("Content-Type", "")
        self._answer(lambda path: post(path, kind, self._body) if post else NOT_FOUND)

    def _body(self, limit: int) -> bytes | None:
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or len(length) > 9 or int(length) > limit:
            return None
        return self.rfile.read(int(length))

    def _answer(self, get: Get) -> None:
        refusal = self.server.guard.refusal(self.headers["Host"], self.headers["Origin"])
        path = self.server.guard.path_after_token(self.path)
        if refusal is not None:
            status, kind, body = HTTPStatus.FORBIDDEN, "text/plain", refusal.encode()
        else:
            status, kind, body = NOT_FOUND if path is None else get(path)
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Referrer-Policy", "no-referrer")  # the address holds the token
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing, because pages poll every few seconds."""
