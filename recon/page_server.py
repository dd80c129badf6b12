"""A small server of pages on this computer, for a recording that is watched and for a mentor who draws.

It is served to this computer alone unless told otherwise. Who asks is looked at first (`recon.own_requests`), then the site finds
an answer. A visitor's whole request must have come after some seconds, however slowly it comes; the size of what is posted is
bounded before any of it is read, and so is the number of visitors at once. Whoever is refused is told to the site, by a line.
"""

import io
import logging
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from time import monotonic
from typing import Protocol

from recon.errors import InputError, reason, short
from recon.own_requests import FOREIGN, LOOPBACK, is_own

log = logging.getLogger(__name__)

MOST_VISITORS = 8  # at once, of a site that names no other number
PATIENCE_S = 5.0  # for a visitor's request, and for the answer to be taken


class Refusal(Exception):
    """A request that isn't answered: its status, and what is said of it."""

    def __init__(self, status: HTTPStatus, words: str) -> None:
        super().__init__(words)
        self.status, self.words = status, words


@dataclass(frozen=True)
class Answer:
    """What a visitor gets."""

    kind: str  # media type
    content: bytes
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Request:
    """A request of a visitor who may ask."""

    method: str  # GET or POST
    path: str
    query: str
    peer: str  # address of the visitor's computer
    kind: str  # media type of what is posted
    body: Callable[[int], bytes]  # reads what is posted, up to a number of bytes; Refusal if it is more, or none


class Site(Protocol):
    """Pages, and what may be posted to them; used by many threads."""

    def answer(self, request: Request) -> Answer | None:
        """Answer a request; None if there is no such page. Refusal if it isn't answered."""

    def refused(self, peer: str, words: str) -> None:
        """Take note of a visitor who was sent away."""


class _OnTime(io.RawIOBase):
    """What a visitor sends until a moment; then TimeoutError."""

    def __init__(self, connection: socket.socket, until: float) -> None:
        self._connection, self._until = connection, until

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:
        left = self._until - monotonic()
        if left <= 0:
            raise TimeoutError("too slow")
        self._connection.settimeout(left)
        return self._connection.recv_into(buffer)


class _Handler(BaseHTTPRequestHandler):
    """Answers one request."""

    site: Site
    listens: str  # host where the server does
    timeout = PATIENCE_S

    def setup(self) -> None:
        """Begin to wait for a request."""
        super().setup()
        self.rfile.close()
        self.rfile = io.BufferedReader(_OnTime(self.connection, monotonic() + (self.timeout or PATIENCE_S)))

    def do_GET(self) -> None:
        """Answer a request."""
        try:
            answer = self._answer()
        except Refusal as refusal:
            self.site.refused(self.client_address[0], refusal.words)
            self._send(refusal.status, Answer("text/plain; charset=utf-8", refusal.words.encode()))
        else:
            self._send(HTTPStatus.OK, answer)

    do_POST = do_GET

    def _answer(self) -> Answer:
        if not is_own(self.headers.get_all("Host", []), self.headers.get_all("Origin", []), self.listens):
            raise Refusal(HTTPStatus.FORBIDDEN, FOREIGN)
        path, _, query = self.path.partition("?")
        kind = self.headers.get_content_type()
        answer = self.site.answer(Request(self.command, path, query, self.client_address[0], kind, self._body))
        if answer is None:
            raise Refusal(HTTPStatus.NOT_FOUND, "expected one of this server's pages, found no such")
        return answer

    def _body(self, most_bytes: int) -> bytes:
        """What is posted; nothing of it is read if it is too long."""
        given = self.headers.get_all("Content-Length", [])
        if self.headers.get("Transfer-Encoding") or len(given) != 1:
            raise Refusal(HTTPStatus.LENGTH_REQUIRED, "expected one Content-Length, found none or another way")
        digits = 18  # of a length: more would be no number of bytes that there are
        if not (given[0].isascii() and given[0].isdigit() and len(given[0]) <= digits):
            raise Refusal(HTTPStatus.BAD_REQUEST, f"Content-Length: expected a number, found {short(given[0])}")
        length = int(given[0])
        if length > most_bytes:
            raise Refusal(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"expected at most {most_bytes} bytes, found {length}")
        content = self.rfile.read(length)
        if len(content) < length:
            raise Refusal(HTTPStatus.BAD_REQUEST, f"expected {length} bytes, found {len(content)}: was the connection lost?")
        return content

    def _send(self, status: HTTPStatus, answer: Answer) -> None:
        self.connection.settimeout(self.timeout)
        self.send_response(status)
        headers = {"Content-Type": answer.kind, "Content-Length": str(len(answer.content)), "Cache-Control": "no-store"}
        for name, value in (headers | {"X-Content-Type-Options": "nosniff"} | dict(answer.headers)).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(answer.content)

    def log_error(self, format: str, *args: object) -> None:
        """Tell the site of a request that is none, or comes too slowly."""
        self.site.refused(self.client_address[0], short(format % args))

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: a browser asks ten times a second."""


class Listening(ThreadingHTTPServer):
    """A server that has its place and answers nobody yet."""

    daemon_threads = True

    def __init__(self, host: str, port: int, most_visitors: int) -> None:
        self._places, self._host = threading.BoundedSemaphore(most_visitors), host
        self._site: Site | None = None
        self.request_queue_size = most_visitors
        super().__init__((host, port), _Handler)

    @contextmanager
    def serving(self, site: Site) -> Iterator[str]:
        """Answer by a site, and give the place back at the end; gives the address."""
        self._site = site
        self.RequestHandlerClass = type("Handler", (_Handler,), {"site": site, "listens": self._host})
        threading.Thread(target=self.serve_forever, daemon=True).start()
        try:
            yield f"http://{self._host}:{self.server_address[1]}/"
        finally:
            self.shutdown()
            self.server_close()

    def process_request(self, request, client_address) -> None:
        """Answer in a thread, if there are not too many."""
        if not self._places.acquire(blocking=False):
            self.shutdown_request(request)
            if self._site is not None:
                self._site.refused(client_address[0], "expected fewer visitors at once, found all places taken")
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request, client_address) -> None:
        """Answer; a visitor who went away is no fault."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request, client_address) -> None:
        """Say nothing of a visitor who went away; a fault of the site itself is logged."""
        error = sys.exception()
        if isinstance(error, Exception) and not isinstance(error, OSError):
            log.error("page: %s: %s", type(error).__name__, reason(error))


def listen(name: str, host: str = LOOPBACK, port: int = 0, most_visitors: int = MOST_VISITORS) -> Listening:
    """Take a place; a port of 0 takes any that is free.

    Parameters
    ----------
    name : of the setting whose fields are host and port

    Raises
    ------
    InputError
        If the port is taken, or the host isn't this computer's.
    """
    try:
        return Listening(host, port, most_visitors)
    except (OSError, OverflowError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{name}: expected {host}:{port} to be free, found: {why}; give {name}.port=0") from None
