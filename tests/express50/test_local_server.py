"""Pages with people in them are served to this machine's browser, and to nobody else."""

import http.client
import socket
import threading
import time
import urllib.request
from contextlib import contextmanager
from http import HTTPStatus

import pytest

from express50 import local_server
from express50.errors import ConfigError
from express50.local_server import NOT_FOUND, PageServer, Reply, RequestGuard


def page(path):
    return Reply(HTTPStatus.OK, "text/plain", b"a face") if path in ("", "x") else NOT_FOUND


def take(path, kind, body):
    content = body(10)
    return NOT_FOUND if content is None else Reply(HTTPStatus.OK, "text/plain", content)


@contextmanager
def served(get=page, host="127.0.0.1"):
    with PageServer(get, take, host, 0) as server:
        thread = threading.Thread(target=server.serve_forever, args=[0.02])
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


def ask(server, path, method="GET", body=None, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=5)
    connection.request(method, path, body, {"Host": f"127.0.0.1:{server.server_port}"} | headers)
    return connection.getresponse()


def test_only_the_address_that_was_printed_gives_the_page():
    with served() as server:
        token = server.guard.token
        assert server.address == f"http://127.0.0.1:{server.server_port}/{token}/"
        assert ask(server, f"/{token}/").read() == b"a face"
        assert ask(server, f"/{token}/x").status == 200
        outside = ["/", "/x", f"/{token}", f"/{token[:-1]}/", "/?/", "/../"]
        for path in outside + [f"/{token}/../x", f"/{token}//etc/passwd"]:
            assert ask(server, path).status == 404
        again = PageServer(page, None, "127.0.0.1", 0)
        again.server_close()
        assert again.guard.token != token


def test_an_address_of_ipv6_can_be_opened():
    assert RequestGuard("::1").address(80).startswith("http://[::1]:80/")
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("this machine has no IPv6")
    with served(host="::1") as server, urllib.request.urlopen(server.address, timeout=5) as reply:
        assert reply.read() == b"a face"


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": ""},
        {"Host": "127.0.0.1.evil.example"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
    ],
)
def test_other_sites_are_refused_even_with_the_token(headers):
    with served() as server:
        for method in ("GET", "POST"):
            reply = ask(server, f"/{server.guard.token}/", method, **headers)
            assert reply.status == 403 and b"face" not in reply.read()


def test_a_server_for_other_machines_checks_token_and_origin():
    guard = RequestGuard("192.0.2.7", "secret")
    assert guard.refusal("lab.example:8000", "http://lab.example:8000") is None
    assert guard.refusal("lab.example:8000", "http://evil.example") is not None
    assert guard.path_after_token("/secret/a") == "a" and guard.path_after_token("/secre/a") is None


def test_bodies_are_bounded():
    with served() as server:
        post = f"/{server.guard.token}/a"
        assert ask(server, post, "POST", b"answer").read() == b"answer"
        assert ask(server, post, "POST", b"x" * 11).status == 404
        assert ask(server, post, "POST", **{"Content-Length": "-1"}).status == 404
        assert ask(server, post, "POST", **{"Content-Length": "9" * 30}).status == 404


def test_slow_requests_and_floods_end(monkeypatch):
    monkeypatch.setattr(local_server, "LONGEST_S", 0.3)
    monkeypatch.setattr(local_server, "AT_ONCE", 3)
    with served() as server:
        slow = [socket.create_connection(("127.0.0.1", server.server_port)) for _ in range(3)]
        host = f"Host: 127.0.0.1:{server.server_port}"
        post = f"POST /{server.guard.token}/a HTTP/1.0\r\n{host}\r\nContent-Length: 8\r\n\r\nab"
        for connection in slow:
            connection.sendall(post.encode())
        time.sleep(0.1)
        with pytest.raises((OSError, http.client.HTTPException)):
            ask(server, f"/{server.guard.token}/")  # no thread is free
        for connection in slow:
            connection.settimeout(5)
            while connection.recv(4096):
                pass
            connection.close()
        time.sleep(0.2)  # a thread is free a moment after its connection has ended
        assert ask(server, f"/{server.guard.token}/").status == 200


def test_a_bug_in_a_page_is_one_line(capsys):
    def broken(path):
        raise KeyError("frame")

    with served(broken) as server:
        with pytest.raises((OSError, http.client.HTTPException)):
            ask(server, f"/{server.guard.token}/")
        time.sleep(0.05)
    error = capsys.readouterr().err.strip()
    assert "KeyError" in error and "\n" not in error


def test_a_port_out_of_range_is_one_error():
    with pytest.raises(ConfigError, match="port 70000: expected 0 to 65535"):
        PageServer(page, None, "127.0.0.1", 70000)


@pytest.mark.parametrize("host", ["192.0.2.1", "no-such-host.invalid"])
def test_an_address_of_another_machine_is_one_error(host):
    with pytest.raises(ConfigError, match=f"{host}: .*; expected an address of this machine"):
        PageServer(page, None, host, 0)
