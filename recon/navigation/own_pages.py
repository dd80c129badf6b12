"""Connections to the view's server from its own pages alone.

A browser lets any page that it shows connect to any server that it can reach, those on this computer too, and only the server can
say no, by the page's origin. viser takes all pages and has no setting for that. So the function by which it begins to serve is
replaced while it does so, by one that looks at each request first.
"""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from recon.errors import short

log = logging.getLogger(__name__)

HERE = ("127.0.0.1", "localhost")  # names of this computer, for itself


@contextmanager
def own_pages_alone(host: str) -> Iterator[None]:
    """Let a server of websockets that begins meanwhile refuse what pages of other origins ask for; `host` is where it listens."""
    from websockets.asyncio import server  # comes with viser

    serve, guarded = server.serve, []

    def serve_own(*given: Any, process_request: Callable | None = None, **others: Any) -> Any:
        guarded.append(True)
        return serve(*given, process_request=partial(_looked_at, host, process_request), **others)

    server.serve = serve_own  # type: ignore[assignment]
    try:
        yield
    finally:
        server.serve = serve
    if not guarded:
        log.warning("view: this version of viser can't be guarded: pages that other browser windows show can read it, too")


def is_own(origins: list[str], asked: list[str], host: str) -> bool:
    """Whether a request comes from a page of this server's own, or from no page at all.

    Parameters
    ----------
    origins, asked : headers Origin, scheme and place of the page; and Host, the place that was asked
    host : where the server listens

    Where it listens to this computer alone, the place must have a name of this computer: names of others may be led here, too.
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
    return page.netloc.lower() == asked[0].lower() and (host not in HERE or named in HERE)


def _looked_at(host: str, process: Callable | None, connection: Any, request: Any) -> Any:
    """The answer of a server to a request, by `process` if it is from a page of its own."""
    origins = request.headers.get_all("Origin")
    if not is_own(origins, request.headers.get_all("Host"), host):
        log.info("view: a page of %s is refused", short(", ".join(origins)))
        return connection.respond(HTTPStatus.FORBIDDEN, "expected a page of this server's own\n")
    return None if process is None else process(connection, request)
