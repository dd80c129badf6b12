"""Our client, its sources by pyigtl, by bytes as PLUS writes them, and by our server."""

import logging
import signal
import socket
import struct
import time
from contextlib import contextmanager

import numpy as np
import pytest

from recon.devices.interfaces import DeviceError
from recon.devices.openigtlink import igtl_client, igtl_header, igtl_messages
from recon.devices.openigtlink.igtl_client import Client
from recon.devices.openigtlink.igtl_messages import Message, Raw, Text, Transform
from recon.devices.openigtlink.igtl_server import Server
from tests.patience import PATIENCE_S
from tests.recon.devices.openigtlink.igtl_peers import TIME_NS, plus_frame, plus_image, pose, served


@contextmanager
def client(port: int, **fields):
    client = Client(port=port, **fields)
    try:
        yield client
    finally:
        client.close()


def receive(client: Client) -> Message:
    received = client.receive(PATIENCE_S)
    assert received is not None, client.state
    return received.message


def test_what_plus_sends_is_received(rng):
    """Protocol 3 with metadata, by hand: names, stamps, numbers, images to the byte and in their places."""
    matrix, levels = pose(rng), rng.integers(0, 256, (30, 40), np.uint8)
    content = matrix[:3].T.astype(">f4").tobytes()
    data = plus_frame(b"TRANSFORM", b"ProbeToTracker", content, [(b"TransformStatus", b"OK")]) + plus_image(levels)
    with served(data[:100], data[100:]) as (port, _), client(port) as ours:
        transform, image = receive(ours), receive(ours)
    assert (transform.device, transform.time_ns, transform.number) == ("ProbeToTracker", TIME_NS, 7)
    assert transform.metadata == {"TransformStatus": "OK"}
    np.testing.assert_array_equal(transform.content.matrix, matrix)
    assert image.metadata["FrameNumber"] == "12" and image.device == "Image_Reference"
    np.testing.assert_array_equal(image.content.levels, levels)
    middle = image.content.ras_from_index @ [19.5, 14.5, 0, 1]
    np.testing.assert_allclose(middle[:3], [40, 30, 20], atol=1e-5)
    np.testing.assert_allclose(image.content.ras_from_index[:3, 1], [0, 0.2, 0], atol=1e-7)


def test_what_pyigtl_sends_is_received(rng):
    pyigtl = pytest.importorskip("pyigtl")
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    server = pyigtl.OpenIGTLinkServer(port=0, local_server=True)
    matrix, place = pose(rng), pose(rng)
    levels = rng.integers(0, 4096, (3, 20, 30), np.uint16)
    try:
        with client(server.server_address[1]) as ours:
            for message in (
                pyigtl.TransformMessage(matrix, device_name="ProbeToTracker", timestamp=1.79e9 + 0.25),
                pyigtl.ImageMessage(levels, place, "lps", device_name="Volume", timestamp=1.79e9),
                pyigtl.StringMessage("freeze", device_name="Command"),
            ):
                server.send_message(message, wait=False)
            transform, image, text = receive(ours), receive(ours), receive(ours)
    finally:
        server.stop()
        for number, handler in handlers.items():
            signal.signal(number, handler)
    np.testing.assert_allclose(transform.content.matrix, matrix, rtol=1e-6, atol=1e-6)
    assert transform.time_ns == 1_790_000_000_250_000_000 and transform.device == "ProbeToTracker"
    np.testing.assert_array_equal(image.content.levels, levels)
    np.testing.assert_allclose(image.content.ras_from_index, np.diag([-1, -1, 1, 1]) @ place, rtol=1e-5, atol=1e-2)
    assert text.content == Text("freeze")


def test_a_source_that_comes_back_is_connected_to_again(caplog, monkeypatch):
    monkeypatch.setattr(igtl_client, "AGAIN_S", 0.05)
    first = Server(port=0)
    port = first.port
    with client(port) as ours:
        first.publish(Message("State", Text("before")))
        before = ours.receive(PATIENCE_S)
        first.close()
        assert ours.receive(0.3) is None and not ours.connected
        second = Server(port=port)
        second.publish(Message("State", Text("after")))
        after = ours.receive(PATIENCE_S)
        second.close()
    assert (before.message.content, after.message.content) == (Text("before"), Text("after"))
    assert after.number == before.number + 2  # a gap
    assert 1 <= len(caplog.records) <= 2  # that it has gone, and that it stays away


@pytest.mark.parametrize(
    ("garbage", "match"),
    [
        (b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n" * 3, "expected one of OpenIGTLink"),
        (igtl_header.HEADER.pack(1, b"IMAGE", b"Image", 0, 4 << 30, 0), "body of at most"),
    ],
    ids=["http", "4 GB"],
)
def test_a_source_of_garbage_is_given_up_and_tried_again(caplog, monkeypatch, garbage, match):
    """A stream that isn't one has no place to go on from; a new connection begins with a header."""
    monkeypatch.setattr(igtl_client, "AGAIN_S", 0.05)
    with served(garbage) as (port, connections), client(port) as ours:
        end, states = time.monotonic() + PATIENCE_S, set[str]()
        while (len(connections) < 4 or len(states) < 2) and time.monotonic() < end:
            states.add(ours.state)
            time.sleep(0.01)
        assert ours.receive(0) is None
    assert len(connections) >= 4 and any(match in state for state in states)
    assert len(caplog.records) == 1 and match in caplog.text


def test_bodies_that_are_no_message_are_left_out(caplog):
    bad = plus_frame(b"TRANSFORM", b"NeedleToTracker", struct.pack(">12f", *[np.nan] * 12), [])
    good = plus_frame(b"STRING", b"State", b"\0\3\0\2ok", [])
    with served(bad + good) as (port, _), client(port) as ours:
        assert receive(ours).content == Text("ok")
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "TRANSFORM of 'NeedleToTracker': expected finite numbers" in caplog.text


def test_what_nobody_fetches_is_bounded_and_counted(monkeypatch):
    monkeypatch.setattr(igtl_client, "MOST_WAITING", 10)
    words = [igtl_messages.pack(Message("State", Text(str(k)))) for k in range(50)]
    with served(b"".join(words)) as (port, _), client(port) as ours:
        end = time.monotonic() + PATIENCE_S
        while ours.lost < 40 and time.monotonic() < end:
            time.sleep(0.01)
        found = [ours.receive(PATIENCE_S) for _ in range(10)]
    assert [one.number for one in found] == list(range(40, 50)) and ours.lost == 40
    assert [one.message.content.text for one in found] == [str(k) for k in range(40, 50)]


def test_bytes_that_nobody_fetches_are_bounded(monkeypatch):
    monkeypatch.setattr(igtl_client, "MOST_WAITING_BYTES", 10_000)
    frames = [plus_image(np.full((30, 100), k, np.uint8)) for k in range(8)]
    with served(b"".join(frames)) as (port, _), client(port) as ours:
        end = time.monotonic() + PATIENCE_S
        while ours.lost < 5 and time.monotonic() < end:
            time.sleep(0.01)
        assert [int(receive(ours).content.plane[0, 0]) for _ in range(3)] == [5, 6, 7]


def test_unwanted_messages_are_seen_but_not_read():
    data = plus_image(np.zeros((3, 4), np.uint8)) + plus_frame(b"STRING", b"State", b"\0\3\0\2ok", [])
    with served(data) as (port, _), client(port, wanted=lambda header: header.kind == "STRING") as ours:
        assert receive(ours).content == Text("ok")
        assert ours.seen == ("IMAGE of 'Image_Reference'", "STRING of 'State'")


def test_a_stream_is_asked_for_at_each_connection():
    server = Server(port=0)
    server.publish(Message("ProbeToTracker", Transform(np.eye(4))))
    with client(server.port, first=[Message("", Raw("STT_TRANS"))]) as ours:
        kinds = {receive(ours).kind, receive(ours).kind}
    server.close()
    assert kinds == {"TRANSFORM", "RTS_TRANS"}


@pytest.mark.parametrize("host", ["nowhere.invalid", "a" * 70, "127.0.0.1\0"])
def test_hosts_that_are_none_are_named(host):
    with client(18944, host=host) as ours:
        assert ours.receive(0.3) is None
        assert len(ours.state.splitlines()) == 1 and ours._thread.is_alive()


def test_ports_that_are_none_are_refused():
    with pytest.raises(DeviceError, match="port: expected 1 to 65535, found 70000"):
        Client(port=70000)


def test_a_place_without_a_server_is_named():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with client(port) as ours:
        assert ours.receive(0.2) is None
        assert not ours.connected and "refused" in ours.state
