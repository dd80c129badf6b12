"""Connections to the view's server from its own pages alone.

A browser lets any page that it shows connect to any server that it can reach, those on this computer too, and only the server can
say no, by the page's origin. viser takes all pages and has no setting for that. So the function by which it begins to serve is
replaced while it does so, by one that looks at each request first.
"""

import logging
import re
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http import HTTPStatus
from importlib.metadata import version
from typing import Any
from urllib.parse import urlsplit

from recon.errors import InputError, short

log = logging.getLogger(__name__)

QUIET = logging.getLogger(f"{__name__}.handshakes")  # of peers that are no browsers or go away, by tracebacks
QUIET.setLevel(logging.CRITICAL)

MOST_NAMED = 20  # origins that are refused, each once
HERE = ("127.0.0.1", "localhost")  # names of this computer, for itself


@contextmanager
def own_pages_alone(host: str) -> Iterator[None]:
    """Have the websocket server that begins within refuse pages of other origins; `host` is where it listens.

    Raises
    ------
    InputError
        If none has begun by the function that is replaced, as of another version of viser: it is unguarded.
    """
    from websockets.asyncio import server  # comes with viser

    serve, guarded, refused = server.serve, [], set[str]()

    def serve_own(*given: Any, process_request: Callable | None = None, **others: Any) -> Any:
        guarded.append(True)
        others.setdefault("logger", QUIET)
        return serve(*given, process_request=partial(_answer, host, refused, process_request), **others)

    server.serve = serve_own  # type: ignore[assignment]
    try:
        yield
    finally:
        server.serve = serve
    if not guarded:
        expected = "a version of viser that can be guarded against pages of other origins"
        raise InputError(f"view: expected {expected}, found {version('viser')}; install that of constraints.txt")


def is_own(origins: list[str], asked: list[str], host: str) -> bool:
    """Whether a request comes from a page of this server's own, or from no page at all.

    Parameters
    ----------
    origins, asked : headers Origin, scheme and place of the page; and Host, the place that was asked
    host : where the server listens

    The place must be this computer's by name or number: whoever owns another name can lead it here.
    """
    if not origins:  # other programs than browsers
        return True
    if len(origins) != 1 or len(asked) != 1:
        return False
    try:
        page = urlsplit(origins[0])
        named = page.hostname
    except ValueError:  # no address at all
        return False
    return page.netloc.lower() == asked[0].lower() and named is not None and _is_here(named, host)


def _is_here(name: str, host: str) -> bool:
    """Whether a name or an address may stand for this computer, where it listens to itself alone or to a network."""
    if name in HERE or host in HERE:
        return name in HERE
    own = {host.lower(), socket.gethostname().lower(), socket.getfqdn().lower()}
    return name in own or bool(re.fullmatch(r"[\d.]+|[\da-f:]+", name))  # a page led here by name never has an address


def _answer(host: str, refused: set[str], process: Callable | None, connection: Any, request: Any) -> Any:
    """The answer of a server to a request, by `process` if it is from a page of its own."""
    origins = request.headers.get_all("Origin")
    if not is_own(origins, request.headers.get_all("Host"), host):
        origin = short(", ".join(origins))
        if origin not in refused and len(refused) < MOST_NAMED:
            refused.add(origin)
            log.warning("view: a page of %s is refused; open the address that was printed", origin)
        return connection.respond(HTTPStatus.FORBIDDEN, "expected a page of this server's own\n")
    return None if process is None else process(connection, request)
