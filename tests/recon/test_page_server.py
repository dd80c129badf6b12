"""The server reads no more than it must, waits no longer than it should, and isn't stopped by whoever asks strange things."""

import socket
from http import HTTPStatus
from urllib.parse import urlsplit

import pytest

from recon import page_server
from recon.errors import InputError
from recon.page_server import Answer, Refusal, listen
from tests.recon.navigation.live_stand_ins import until
from tests.recon.web_visitors import answer


class Echo:
    """Answers with what was posted, up to ten bytes; keeps who was refused."""

    def __init__(self):
        self.told = []

    def answer(self, request):
        if request.path == "/bad":
            raise Refusal(HTTPStatus.CONFLICT, "expected another, found this")
        return Answer("text/plain", request.body(10)) if request.method == "POST" else None

    def refused(self, peer, words):
        self.told.append(words)


@pytest.fixture
def echo(monkeypatch):
    monkeypatch.setattr(page_server._Handler, "timeout", 0.3)
    site = Echo()
    with listen("echo").serving(site) as address:
        yield site, address


def connected(address):
    visitor = socket.create_connection((urlsplit(address).hostname, urlsplit(address).port), 20)
    return visitor, f"Host: {urlsplit(address).netloc}\r\n".encode()


def everything(visitor):
    """All that the server sends until it hangs up."""
    content = b""
    while piece := visitor.recv(4096):
        content += piece
    return content


def test_what_is_posted_is_read_and_what_is_refused_is_told(echo):
    site, address = echo
    assert answer(address, "/", b"0123456789") == (200, b"0123456789")
    assert answer(address, "/bad") == (409, b"expected another, found this")
    assert answer(address, "/nowhere")[0] == 404
    assert (
        answer(address, "/", b"a", Host="evil.example")[0] == answer(address, "/", b"a", Origin="https://evil.example")[0] == 403
    )
    assert len(site.told) == 4 and site.told[0] == "expected another, found this"


@pytest.mark.parametrize(("length", "status"), [
    (b"4294967296", 413),  # 4 GB, of which nothing is sent
    (b"11", 413),
    (b"9" * 400, 400),
    (b"-1", 400),
    (b"ten", 400),
    ("١٢".encode(), 400),  # digits, but no ASCII
    (b"5\r\nContent-Length: 6", 411),
    (None, 411),
    (b"3\r\nTransfer-Encoding: chunked", 411),
])  # fmt: skip
def test_lengths_are_looked_at_before_anything_is_read(echo, length, status):
    site, address = echo
    visitor, host = connected(address)
    with visitor:
        given = b"" if length is None else b"Content-Length: " + length + b"\r\n"
        visitor.sendall(b"POST / HTTP/1.1\r\n" + host + given + b"\r\n")
        assert int(everything(visitor).split()[1]) == status
    assert len(site.told) == 1


def test_a_visitor_who_sends_a_byte_now_and_then_is_sent_away(echo):
    """Each byte comes long before the time is over: it is the whole that must come in time."""
    site, address = echo
    visitor, host = connected(address)
    with visitor:
        visitor.sendall(b"POST / HTTP/1.1\r\n" + host + b"Content-Length: 10\r\n\r\n")
        visitor.settimeout(0.05)
        for _ in range(9):  # one byte less than it should be
            try:
                visitor.send(b"a")
                if visitor.recv(10) == b"":
                    break
            except TimeoutError:
                continue
            except ConnectionError:
                break
        until(lambda: site.told)
    assert "timed out" in site.told[0]


def test_strange_and_silent_visitors_dont_stop_it(echo):
    site, address = echo
    silent = [connected(address)[0] for _ in range(page_server.MOST_VISITORS)]
    for content in (b"\x00" * 100, b"GET " + b"/" * 100_000, b"POST / HTTP/1.1\r\n\r\n"):
        with connected(address)[0] as visitor:
            visitor.sendall(content)
    for visitor in silent:
        assert visitor.recv(1) == b""  # sent away after a while
        visitor.close()
    assert answer(address, "/", b"still")[1] == b"still"
    assert any("all places taken" in words for words in site.told)


def test_a_taken_port_is_named():
    with listen("echo").serving(Echo()) as address:
        port = urlsplit(address).port
        with pytest.raises(InputError, match=f"echo: expected 127.0.0.1:{port} to be free"):
            listen("echo", port=port)
