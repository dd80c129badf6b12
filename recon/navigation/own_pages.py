"""Connections to the view's server from its own pages alone, by the rule of `recon.own_requests`.

viser takes all pages and has no setting for that. So the function by which it begins to serve is replaced while it does so, by
one that looks at each request first.
"""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http import HTTPStatus
from importlib.metadata import version
from typing import Any

from recon.errors import InputError, short
from recon.own_requests import FOREIGN, is_own

log = logging.getLogger(__name__)

QUIET = logging.getLogger(f"{__name__}.handshakes")  # of peers that are no browsers or go away, by tracebacks
QUIET.setLevel(logging.CRITICAL)


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


def _answer(host: str, refused: set[str], process: Callable | None, connection: Any, request: Any) -> Any:
    """The answer of a server to a request, by `process` if it is from a page of its own."""
    hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
    most_named = 20  # pages that are refused, each once
    if not is_own(hosts, origins, host):
        page = short(", ".join(origins or hosts))
        if page not in refused and len(refused) < most_named:
            refused.add(page)
            log.warning("view: %s is refused: %s", page, FOREIGN)
        return connection.respond(HTTPStatus.FORBIDDEN, f"{FOREIGN}\n")
    return None if process is None else process(connection, request)
