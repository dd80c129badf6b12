"""Our server, its clients by pyigtl and by bare sockets."""

import logging
import socket
import threading
import time
from contextlib import suppress

import numpy as np
import pytest

from recon.devices.interfaces import DeviceError
from recon.devices.openigtlink import igtl_header, igtl_messages, igtl_server
from recon.devices.openigtlink.igtl_image import Image
from recon.devices.openigtlink.igtl_messages import Message, Points, Raw, Status, Text, Transform
from recon.devices.openigtlink.igtl_model import Model
from recon.devices.openigtlink.igtl_server import Server
from recon.devices.openigtlink.igtl_stream import Splitter
from recon.errors import InputError
from tests.patience import PATIENCE_S
from tests.recon.devices.open_sockets import sockets
from tests.recon.devices.openigtlink.igtl_peers import TIME_NS, pose


@pytest.fixture
def server():
    server = Server(port=0)
    yield server
    server.close()


def connected(server: Server) -> socket.socket:
    before = server.clients
    connection = socket.create_connection(("127.0.0.1", server.port), PATIENCE_S)
    assert until(lambda: server.clients == before + 1)
    return connection


def until(holds, seconds: float = PATIENCE_S) -> bool:
    end = time.monotonic() + seconds
    while not holds() and time.monotonic() < end:
        time.sleep(0.005)
    return holds()


def received(connection: socket.socket, count: int) -> list[Message]:
    """Messages of a client of our own."""
    splitter, found = Splitter(), []
    while len(found) < count:
        found += [message for message, _ in splitter.feed(connection.recv(1 << 16))]
    return found


@pytest.mark.parametrize("version", [1, 2])
def test_pyigtl_receives_the_same(rng, version):
    """Names, time stamps, transforms to 1e-6, images to the byte and in their places."""
    pyigtl = pytest.importorskip("pyigtl")
    server = Server(port=0, version=version)
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", server.port)
    matrix, place = pose(rng), pose(rng)
    levels = rng.integers(0, 256, (40, 30), np.uint8)
    points = rng.normal(0, 100, (2, 3))
    server.publish(Message("ProbeToTracker", Transform(matrix), TIME_NS, {"Sigma": "0.1"}))
    server.publish(Message("Image_Reference", Image(levels, place), TIME_NS))
    server.publish(Message("State", Text("tracking"), TIME_NS))
    server.publish(Message("Masses", Points(("m1", "m2"), points), TIME_NS))
    try:
        transform = client.wait_for_message("ProbeToTracker", PATIENCE_S)
        np.testing.assert_allclose(transform.matrix, matrix, rtol=1e-6, atol=1e-6)
        assert abs(transform.timestamp - TIME_NS / 1e9) < 1e-6  # a float of seconds since 1970 has 0.2 us
        assert transform.metadata == ({"Sigma": "0.1"} if version == 2 else {})
        image = client.wait_for_message("Image_Reference", PATIENCE_S)
        assert np.array_equal(image.image[0], levels) and image.world_coordinate_system == "ras"
        np.testing.assert_allclose(image.ijk_to_world_matrix, place, rtol=1e-5, atol=1e-2)  # (30 px from the middle) * float32
        assert client.wait_for_message("State", PATIENCE_S).string == "tracking"
        found = client.wait_for_message("Masses", PATIENCE_S)
        np.testing.assert_allclose(found.positions, points, rtol=1e-6)
        assert found.names == ["m1", "m2"]
    finally:
        client.stop()
        server.close()


def test_who_comes_late_gets_the_newest_of_each_name(server, rng):
    model = Model(rng.normal(size=(4, 3)), np.array([[0, 1, 2]]))
    server.publish(Message("Skin", model))
    for k in range(5):
        server.publish(Message("State", Text(str(k))))
    found = received(connected(server), 2)
    assert [message.device for message in found] == ["Skin", "State"] and found[1].content == Text("4")


def test_two_clients_get_all(server):
    first, second = connected(server), connected(server)
    server.publish(Message("State", Text("both")))
    for connection in (first, second):
        assert received(connection, 1)[0].content == Text("both")


def test_a_client_that_takes_nothing_holds_up_nobody(server, monkeypatch):
    """A hundred images of 1 MB: the sleeping client misses some, its last one is the newest, and its memory is bounded.

    It isn't dropped for its sleep, so that who waits for it waits for ever.
    """
    monkeypatch.setattr(igtl_server, "STALLED_S", 10 * PATIENCE_S)
    sleeping, waking = connected(server), connected(server)
    splitter, seen = Splitter(), []

    def read() -> None:
        while not seen or seen[-1] != 99:
            seen.extend(int(message.content.plane[0, 0]) for message, _ in splitter.feed(waking.recv(1 << 20)))

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    for k in range(100):
        levels = np.full((1000, 1000), k, np.uint8)
        server.publish(Message("Image", Image(levels, np.eye(4))))
        assert until(lambda k=k: bool(seen) and seen[-1] >= k)
    reader.join(PATIENCE_S)
    assert seen[-1] == 99 and len(seen) > 50
    late = []
    splitter = Splitter()
    while not late or late[-1] != 99:
        late += [int(message.content.plane[0, 0]) for message, _ in splitter.feed(sleeping.recv(1 << 20))]
    assert len(late) < 50 and late == sorted(late)


@pytest.mark.parametrize(
    "garbage",
    [
        b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n" * 5,
        bytes(200),
        igtl_header.HEADER.pack(1, b"GET_IMAGE", b"Image", 0, 4 << 30, 0),
        igtl_header.HEADER.pack(1, b"IMAGE", b"Image", 0, 2**64 - 1, 0),
    ],
    ids=["http", "zeros", "4 GB", "2**64"],
)
def test_clients_that_send_garbage_are_dropped_with_one_line(server, caplog, garbage):
    good, bad = connected(server), connected(server)
    with caplog.at_level(logging.WARNING):
        bad.sendall(garbage)
        with suppress(ConnectionResetError):
            assert bad.recv(100) == b""
        assert until(lambda: server.clients == 1)
    assert len(caplog.records) == 1 and " is dropped: " in caplog.text
    server.publish(Message("State", Text("still here")))
    assert received(good, 1)[0].content == Text("still here")


def ask(connection: socket.socket, kind: str, device: str = "") -> Message:
    connection.sendall(igtl_messages.pack(Message(device, Raw(kind)), version=1))
    return received(connection, 1)[0]


def test_queries_are_answered(server):
    connection = connected(server)
    assert ask(connection, "GET_STATUS").content.code == igtl_messages.OK
    assert ask(connection, "GET_IMAGE", "Image").content == Raw("IMAGE")  # there is none
    assert ask(connection, "STT_TDATA").content == Raw("RTS_TDATA", b"\1")
    server.publish(Message("State", Status(13, "no target")))
    server.publish(Message("ProbeToTracker", Transform(np.eye(4))))
    received(connection, 2)
    assert ask(connection, "GET_STATUS").content.text == "no target"
    assert ask(connection, "GET_TRANS", "ProbeToTracker").device == "ProbeToTracker"
    assert ask(connection, "GET_TRANS", "Other").content == Raw("TRANSFORM")
    assert ask(connection, "STT_TRANS").content == Raw("RTS_TRANS", b"\0")


def test_a_client_that_asks_without_end_is_dropped(server, monkeypatch, caplog):
    """Each answer waits under a name of its own; the client takes none."""
    monkeypatch.setattr(igtl_server, "MOST_NAMES", 4)
    monkeypatch.setattr(igtl_server._Client, "_send_all", lambda self: None)
    connection = connected(server)
    connection.sendall(b"".join(igtl_messages.pack(Message(str(k), Raw("GET_STATUS")), version=1) for k in range(20)))
    assert until(lambda: server.clients == 0)
    assert "that takes its answers" in caplog.text


def test_a_stream_of_bad_clients_fills_no_log(server, caplog):
    for _ in range(30):
        with socket.create_connection(("127.0.0.1", server.port), PATIENCE_S) as connection, suppress(OSError):
            connection.sendall(bytes(100))
            connection.recv(1)
    assert until(lambda: server.clients == 0)
    assert len(caplog.records) <= 10


def test_what_clients_publish_is_left_out(server, rng):
    """3D Slicer may be set to send its images."""
    connection = connected(server)
    connection.sendall(igtl_messages.pack(Message("Volume", Image(rng.integers(0, 9, (500, 500), np.uint8), np.eye(4)))))
    assert ask(connection, "GET_STATUS").kind == "STATUS"


def test_clients_beyond_the_bound_are_refused(server, monkeypatch):
    monkeypatch.setattr(igtl_server, "MOST_CLIENTS", 1)
    first = connected(server)
    assert socket.create_connection(("127.0.0.1", server.port), PATIENCE_S).recv(1) == b""
    first.close()
    assert until(lambda: server.clients == 0)
    connected(server).close()


def test_a_used_port_is_named(server):
    with pytest.raises(DeviceError, match=f"127.0.0.1:{server.port}: expected a free port .* such as PlusServer"):
        Server(port=server.port)


@pytest.mark.parametrize("host", ["203.0.113.7", "a" * 70])  # an address for documentation, which is nobody's
def test_addresses_of_others_are_named(host):
    before = sockets()
    with pytest.raises(DeviceError, match="expected a free port of this computer, found") as caught:
        Server(host, port=0)
    assert len(str(caught.value).splitlines()) == 1 and sockets() == before


def test_a_server_that_cannot_begin_leaves_its_port_free(monkeypatch):
    def fail(_):
        raise RuntimeError("can't start new thread")

    before = sockets()
    monkeypatch.setattr(threading.Thread, "start", fail)
    with pytest.raises(RuntimeError) as caught:
        Server(port=0)
    assert sockets() == before and caught.tb  # which would keep a socket that nobody has closed


def test_an_open_address_is_told(caplog):
    Server("0.0.0.0", port=0).close()
    assert "anybody who reaches this computer can read" in caplog.text


def test_gone_clients_hold_nothing(server):
    connection = connected(server)
    connection.close()
    assert until(lambda: server.clients == 0)
    server.publish(Message("State", Text("to nobody")))
    assert not server._clients


def test_names_are_bounded(server, monkeypatch):
    monkeypatch.setattr(igtl_server, "MOST_NAMES", 2)
    server.publish(Message("a", Text("")))
    server.publish(Message("b", Text("")))
    server.publish(Message("a", Text("again")))
    with pytest.raises(InputError, match="at most 2 names"):
        server.publish(Message("c", Text("")))


def test_closing_ends_all_connections(server):
    connection = connected(server)
    server.close()
    assert connection.recv(10) == b""
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", server.port), 1)
