"""Requests that a page's server on this computer may answer: those of its own pages, and of programs that are no browsers.

A browser lets any page that it shows ask any server that it can reach, those on this computer too, and only the server can say
no. Two headers say who asks. Host is the place that was asked, by its name: whoever owns a name can lead it here, and then reads
the answers as its own, so it must be a name or a number of this computer. Origin is the place of the page that asks, where a
browser sends it: it must be the place that was asked.
"""

import socket
from collections.abc import Sequence
from functools import cache
from ipaddress import ip_address
from urllib.parse import urlsplit

LOOPBACK = "127.0.0.1"
FOREIGN = "expected a page of this server's own: open it by this computer's number, or let it listen at the name (host)"
HERE = (LOOPBACK, "localhost", "::1")  # names of this computer, for itself


def is_own(hosts: Sequence[str], origins: Sequence[str], listens: str) -> bool:
    """Whether a request comes from a page of the server's own, or from no page at all.

    Parameters
    ----------
    hosts, origins : headers Host and Origin, as often as they were sent
    listens : where the server listens
    """
    if len(hosts) != 1 or len(origins) > 1:
        return False
    try:
        named = urlsplit(f"//{hosts[0]}").hostname
        pages = [urlsplit(origin).netloc.lower() for origin in origins]
    except ValueError:  # no address at all
        return False
    return named is not None and _is_here(named, listens) and all(page == hosts[0].lower() for page in pages)


def _is_here(name: str, listens: str) -> bool:
    """Whether a name or number may stand for this computer, which listens to itself alone or to a network."""
    if name in HERE or listens in HERE:
        return name in HERE
    return name in {listens.lower(), *own_names()} or _is_number(name)  # a page led here by name never has a number


@cache
def own_names() -> tuple[str, str]:
    """Names of this computer, found once: the longer one may take a question to a name server."""
    return socket.gethostname().lower(), socket.getfqdn().lower()


def _is_number(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True
