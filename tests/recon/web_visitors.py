"""A visitor of a page without a browser."""

from http.client import HTTPConnection
from urllib.parse import urlsplit


def answer(address: str, path: str, posted: bytes | None = None, **headers: str) -> tuple[int, bytes]:
    """Status and content of an answer, to a GET or, with something to post, a POST."""
    connection = HTTPConnection(urlsplit(address).hostname, urlsplit(address).port, timeout=600)
    connection.request("GET" if posted is None else "POST", path, posted, headers)
    response = connection.getresponse()
    try:
        return response.status, response.read()
    finally:
        connection.close()
