"""A stranger's page in the surgeon's browser gets nothing of the view."""

import socket
import subprocess
import sys
from http.client import HTTPConnection

import numpy as np
import pytest

from recon.errors import InputError
from recon.navigation import own_pages
from recon.navigation.browser_view import LOOPBACK, BrowserView
from recon.navigation.publishing import StillScene
from tests.recon.navigation.test_browser_view import free_port

pytest.importorskip("viser")


@pytest.fixture(scope="module")
def port():
    view = BrowserView(StillScene(np.eye(4)), free_port())
    yield view._server.get_port()
    view.close()


def answer(port: int, origin: str | None, host: str | None = None) -> int:
    """Status of a handshake; 101 begins a connection."""
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    try:
        reached = socket.create_connection((LOOPBACK, port), 600)
        with connect(f"ws://{host or LOOPBACK}:{port}", sock=reached, origin=origin, subprotocols=["viser-v0"]) as opened:
            return opened.response.status_code
    except InvalidStatus as refused:
        return refused.response.status_code


def page_status(port: int, host: str) -> int:
    """Status of the page itself, asked for by a name."""
    connection = HTTPConnection(LOOPBACK, port, timeout=600)
    connection.request("GET", "/", headers={"Host": f"{host}:{port}"})
    return connection.getresponse().status


def test_its_own_page_and_other_programs_are_let_in(port):
    assert answer(port, f"http://{LOOPBACK}:{port}") == 101
    assert answer(port, f"http://localhost:{port}", "localhost") == 101
    assert answer(port, None) == 101
    assert page_status(port, LOOPBACK) == page_status(port, "localhost") == 200


def test_a_strangers_page_is_refused(port):
    assert answer(port, "https://example.org") == 403
    assert answer(port, f"http://{LOOPBACK}:{port + 1}") == 403, "a page of another program on this computer"
    assert answer(port, "null") == 403, "a page in a frame without an origin"
    assert answer(port, f"http://rebound.example:{port}", "rebound.example") == 403, "a stranger's name that leads here"
    assert page_status(port, "rebound.example") == 403


def test_a_server_that_cant_be_guarded_is_refused():
    """As a version of viser that begins to serve by another function."""
    with pytest.raises(InputError, match="expected a version of viser that can be guarded"), own_pages.own_pages_alone(LOOPBACK):
        pass


STRANGE_PEERS = """
import socket, time
import numpy as np
from recon.navigation.browser_view import LOOPBACK, BrowserView
from recon.navigation.publishing import StillScene
view = BrowserView(StillScene(np.eye(4)), 0)
for sent in (b"", b"garbage\\r\\n\\r\\n"):
    with socket.create_connection((LOOPBACK, view._server.get_port()), 5) as peer:
        peer.sendall(sent)
        time.sleep(0.3)
view.close()
"""


def test_a_peer_that_is_no_browser_leaves_no_traceback():
    """It goes away in the middle, or sends garbage. In a process of its own, whose log is a user's."""
    done = subprocess.run([sys.executable, "-c", STRANGE_PEERS], capture_output=True, text=True, check=True)
    assert "Traceback" not in done.stderr
