import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.devices.openigtlink import igtl_header, igtl_messages
from recon.devices.openigtlink.igtl_header import Header
from recon.devices.openigtlink.igtl_messages import Message, Raw, Status, Text, Tools, Transform
from recon.errors import InputError
from tests.recon.devices.openigtlink.igtl_peers import TIME_NS, all_kinds, pose, same

KINDS = [*igtl_messages.READERS, "GET_STATUS", "CLIENTINFO"]
REFERENCE = np.array([  # the transform of the protocol's own test messages
    [-0.954892, -0.196632, 0.222525, 46.0531],
    [0.196632, 0.142857, 0.970014, 19.4709],
    [-0.222525, 0.970014, -0.0977491, 46.0531],
    [0, 0, 0, 1],
])  # fmt: skip


def read(data: bytes) -> Message:
    header = igtl_header.read_header(data[:58])
    return igtl_messages.unpack(header, igtl_header.checked(header, data[58:]))


@pytest.mark.parametrize("version", [1, 2])
def test_all_kinds_read_back(rng, version):
    for message in all_kinds(rng):
        found = read(igtl_messages.pack(message, version))
        assert same(found.content, message.content), message.device
        assert (found.device, found.time_ns, found.kind) == (message.device, TIME_NS, message.kind)
        assert (dict(found.metadata), found.number) == ((dict(message.metadata), 9) if version == 2 else ({}, 0))


@pytest.mark.parametrize(
    ("content", "checksum"),
    [
        (Transform(REFERENCE), 0xF6DD2B8EB4DF6DD2),
        (Status(15, "Actuator A is disabled.", "ACTUATOR_DISABLED", 10), 0x98EE43EED8E431CF),
        (Text("Welcome to OpenIGTLink"), 0xCEF1B42A701104D4),
    ],
)
def test_bodies_are_those_of_the_reference_library(content, checksum):
    """The library's own test messages end in these checksums, so all their bytes are the same."""
    data = igtl_messages.pack(Message("DeviceName", content), version=1)
    assert igtl_header.read_header(data[:58]).checksum == checksum


def test_metadata_is_that_of_the_reference_library():
    metadata = {"First patient age": "22", "Second patient age": "25"}
    data = igtl_messages.pack(Message("DeviceName", Transform(REFERENCE), None, metadata, 1), version=2)
    header = igtl_header.read_header(data[:58])
    assert (header.size, header.checksum) == (0x75, 0xF698F64FDAE266DD)


def test_positions_are_transforms(rng):
    """A quarter turn about z, with all of the quaternion or three numbers of it; a place alone turns nothing."""
    half = np.sqrt(0.5)
    turned = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])
    for numbers in [(1, 2, 3, 0, 0, half, half), (1, 2, 3, 0, 0, half)]:
        found = unpacked("POSITION", struct.pack(f">{len(numbers)}f", *numbers))
        np.testing.assert_allclose(found.matrix, turned, atol=1e-6)
    place = unpacked("POSITION", struct.pack(">3f", 1, 2, 3))
    np.testing.assert_array_equal(place.matrix[:3, 3], [1, 2, 3])
    np.testing.assert_array_equal(place.matrix[:3, :3], np.eye(3))


def test_tools_with_quaternions_are_the_same_tools():
    half = np.sqrt(0.5)
    found = unpacked("QTDATA", struct.pack(">20sBB7f", b"Probe", 2, 0, 1, 2, 3, half, 0, 0, half))
    assert isinstance(found, Tools) and found.names == ("Probe",) and found.types == (2,)
    np.testing.assert_allclose(found.tracker_from_tool[0, :3, 1], [0, 0, 1], atol=1e-6)  # y goes to z


def test_a_million_tools_are_refused_before_they_take_memory():
    with pytest.raises(InputError, match="at most 10000 records of 70 bytes"):
        unpacked("TDATA", bytes(70 * 10_001))


def test_an_empty_body_says_that_there_is_nothing():
    assert unpacked("TRANSFORM", b"") == Raw("TRANSFORM")


def test_senders_of_impossible_poses_are_named():
    bad = struct.pack(">12f", *[np.nan] * 12)
    with pytest.raises(InputError, match="TRANSFORM of 'Dev': expected finite numbers"):
        unpacked("TRANSFORM", bad)


@pytest.mark.parametrize(
    "content",
    [
        Transform(np.eye(3)),
        Transform(np.full((4, 4), np.nan)),
        Transform(np.ones((4, 4))),
        Text("a" * 70000),
        Status(70000),
        Tools(("n" * 21,), np.eye(4)[None], (2,)),
        Tools(("n",), np.eye(4)[None], (300,)),
    ],
)
def test_what_the_protocol_has_no_room_for_is_refused_in_one_line(content):
    with pytest.raises(InputError) as caught:
        igtl_messages.pack(Message("Dev", content))
    assert len(str(caught.value).splitlines()) == 1


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(KINDS), st.sampled_from([1, 2]), st.binary(max_size=300))
def test_any_body_gives_a_message_or_one_line(kind, version, body):
    try:
        igtl_messages.unpack(Header(version, kind, "Dev", None, len(body), 0), body)
    except InputError as error:
        assert len(str(error).splitlines()) == 1 and len(str(error)) < 400


@settings(max_examples=300, deadline=None)
@given(st.integers(0, 10), st.integers(0, 2**16), st.binary(min_size=1, max_size=8))
def test_any_damage_to_a_valid_body_gives_a_message_or_one_line(which, place, damage):
    rng = np.random.default_rng(which)
    data = bytearray(igtl_messages.pack(all_kinds(rng)[which]))
    header = igtl_header.read_header(bytes(data[:58]))
    at = place % max(header.size, 1)
    body = bytes(data[58:])
    body = body[:at] + damage + body[at + len(damage) :]
    try:
        igtl_messages.unpack(header, body)
    except InputError as error:
        assert len(str(error).splitlines()) == 1


def test_a_transform_loses_no_more_than_float32(rng):
    matrix = pose(rng) + 0.0
    matrix[:3] += rng.normal(0, 1e-3, (3, 4))
    found = read(igtl_messages.pack(Message("A", Transform(matrix)))).content
    np.testing.assert_allclose(found.matrix, matrix, rtol=1e-6)


def unpacked(kind: str, body: bytes) -> igtl_messages.Content:
    return igtl_messages.unpack(Header(1, kind, "Dev", None, len(body), 0), body).content
