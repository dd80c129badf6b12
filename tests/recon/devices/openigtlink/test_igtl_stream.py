import logging
import tracemalloc

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.devices.openigtlink import igtl_header, igtl_messages, igtl_stream
from recon.devices.openigtlink.igtl_header import Body
from recon.devices.openigtlink.igtl_messages import Message, Text
from recon.devices.openigtlink.igtl_stream import Complaints, Pace, Splitter
from recon.errors import InputError
from tests.recon.devices.openigtlink.igtl_peers import all_kinds, same


def texts(splitter: Splitter, data: bytes) -> list[str]:
    return [str(found) if isinstance(found, InputError) else found.content.text for found, _ in splitter.feed(data)]


def packed(*words: str) -> list[bytes]:
    return [igtl_messages.pack(Message("Dev", Text(word))) for word in words]


@pytest.mark.parametrize("piece", [1, 57, 58, 59, 1000, 10**6])
def test_messages_are_whole_however_the_bytes_come(rng, piece):
    messages = all_kinds(rng)
    data, splitter = b"".join(map(igtl_messages.pack, messages)), Splitter()
    found = [one for at in range(0, len(data), piece) for one, _ in splitter.feed(data[at : at + piece])]
    assert [one.device for one in found] == [one.device for one in messages]
    assert all(same(one.content, message.content) for one, message in zip(found, messages, strict=True))


def test_a_damaged_body_is_left_out_and_named():
    first, second, third = packed("one", "two", "three")
    found = texts(Splitter(), first + second[:-1] + b"\xff" + third)
    assert found[::2] == ["one", "three"] and "checksum" in found[1]


def test_senders_without_checksums_are_read_on_demand():
    data = bytearray(packed("one")[0])
    data[50:58] = bytes(8)
    assert texts(Splitter(check=False), data) == ["one"]
    assert "checksum" in texts(Splitter(), data)[0]


def test_peers_of_damaged_bodies_alone_are_given_up():
    damaged = packed("one")[0][:-1] + b"\xff"
    splitter = Splitter()
    with pytest.raises(InputError, match="11 damaged messages one after the other"):
        texts(splitter, damaged * 20)


def test_unwanted_bodies_are_never_held():
    splitter = Splitter(lambda header: header.kind != "IMAGE")
    header = igtl_header.HEADER.pack(1, b"IMAGE", b"Image", 0, 60 << 20, 0)
    piece = bytes(1 << 20)
    tracemalloc.start()
    found = texts(splitter, header)
    for _ in range(60):
        found += texts(splitter, piece)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found == [] and most < 8 << 20  # a few pieces
    assert texts(splitter, packed("after")[0]) == ["after"] and splitter.count == 2


def test_a_header_alone_takes_no_memory():
    """What a peer only announces isn't set aside."""
    tracemalloc.start()
    texts(Splitter(), igtl_header.HEADER.pack(1, b"IMAGE", b"Image", 0, 60 << 20, 0) + bytes(1000))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 1 << 20


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=200), st.booleans())
def test_any_bytes_give_messages_or_one_line(data, after_a_header):
    start = igtl_header.join(1, "STRING", "Dev", None, Body(memoryview(b"\0\3\0\1a"))) if after_a_header else b""
    try:
        for found, _ in Splitter().feed(start + data):
            assert len(str(found).splitlines()) == 1 or isinstance(found, Message)
    except InputError as error:
        assert len(str(error).splitlines()) == 1 and len(str(error)) < 300


def test_a_flood_is_slowed_to_the_bound():
    pace = Pace()
    assert pace.pause(0, 0) == 0  # a second begins
    assert pace.pause(igtl_stream.MOST_MESSAGES_S, 100) == 0
    assert 0.5 < pace.pause(igtl_stream.MOST_MESSAGES_S + 1, 100) <= 1
    assert 0.5 < Pace(pace.begun).pause(1, igtl_stream.MOST_BYTES_S + 1) <= 1


def test_a_peer_fills_no_log(caplog):
    complaints = Complaints(logging.getLogger("peer"), "peer")
    for _ in range(1000):
        complaints.add("garbage")
    assert [record.getMessage() for record in caplog.records] == ["peer: garbage"]
    for k in range(1000):
        complaints.add(str(k))
    assert len(caplog.records) == igtl_stream.MOST_LINES
