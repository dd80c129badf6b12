import numpy as np
import pytest

from recon.devices.openigtlink import igtl_header
from recon.devices.openigtlink.igtl_header import Body, Header
from recon.errors import InputError
from tests.recon.devices.openigtlink.igtl_peers import TIME_NS, plus_frame, slow_crc64


@pytest.mark.parametrize("size", [0, 1, 7, 8, 9, 64, 1001])
def test_the_checksum_is_the_division(rng, size):
    data = rng.bytes(size)
    assert igtl_header.crc64(data) == slow_crc64(data)


def test_the_checksum_is_that_of_ecma_182():
    """The check value that catalogues of checksums list for CRC-64/ECMA-182."""
    assert igtl_header.crc64(b"123456789") == 0x6C40DF5F0B497347


def test_time_stamps_read_back_to_the_nanosecond(rng):
    """A unit of the fraction is 0.23 ns, so that none is lost."""
    for time in [1, 999_999_999, TIME_NS, 2**32 * 10**9 - 1, *rng.integers(0, 4 * 10**18, 1000).tolist()]:
        assert igtl_header.nanoseconds(igtl_header.fixed_point(time)) == time
    assert igtl_header.fixed_point(1_500_000_000) == (1 << 32) + (1 << 31)  # 1.5 s


@pytest.mark.parametrize("time", [-1, 2**32 * 10**9])
def test_times_that_have_no_stamp_are_refused(time):
    with pytest.raises(InputError, match="1970 to 2106"):
        igtl_header.fixed_point(time)


def test_metadata_of_another_sender_is_read():
    data = plus_frame(b"STRING", b"Name", b"content", [(b"Sigma", b"0.1"), (b"Tool", b"")], number=41)
    header = igtl_header.read_header(data[:58])
    assert (header.version, header.kind, header.device, header.time_ns) == (2, "STRING", "Name", TIME_NS)
    parts = igtl_header.split(header, igtl_header.checked(header, data[58:]))
    assert bytes(parts.content) == b"content" and parts.number == 41 and parts.metadata == {"Sigma": "0.1", "Tool": ""}


def test_a_longer_extended_header_is_passed_over():
    """Later protocols may add fields; the header says where the content begins."""
    body = igtl_header.EXTENDED.pack(16, 0, 0, 3) + b"more" + b"content"
    assert bytes(igtl_header.split(Header(2, "STRING", "", None, len(body), 0), body).content) == b"content"


def test_a_damaged_body_is_refused():
    data = bytearray(igtl_header.join(2, "STRING", "Name", None, Body(memoryview(b"content"))))
    data[-1] ^= 1
    header = igtl_header.read_header(bytes(data[:58]))
    with pytest.raises(InputError, match="STRING of 'Name': expected the checksum"):
        igtl_header.checked(header, bytes(data[58:]))


@pytest.mark.parametrize("where", [0, 2, 4])
def test_what_is_no_header_is_refused(where):
    data = bytearray(igtl_header.join(1, "STRING", "Name", None, Body(memoryview(b""))))
    data[where] = 0xFF
    with pytest.raises(InputError, match="expected one of OpenIGTLink"):
        igtl_header.read_header(bytes(data[:58]))


def test_four_gigabytes_are_refused_by_the_header_alone():
    data = igtl_header.HEADER.pack(1, b"IMAGE", b"Image", 0, 4 << 30, 0)
    with pytest.raises(
        InputError, match=f"IMAGE of 'Image': expected a body of at most {64 << 20} bytes, found one of {4 << 30}"
    ):
        igtl_header.read_header(data)


@pytest.mark.parametrize("sizes", [(12, 0, 100), (12, 100, 0), (5, 0, 0), (60000, 2, 0), (12, 2, 2**32 - 1)])
def test_sizes_that_the_body_has_no_room_for_are_refused(sizes):
    body = igtl_header.EXTENDED.pack(*sizes, 0) + b"content"
    with pytest.raises(InputError, match="room for"):
        igtl_header.split(Header(2, "STRING", "", None, len(body), 0), body)


@pytest.mark.parametrize(("kind", "device"), [("", "a"), ("THIRTEEN_LETT", "a"), ("IMAGE", "d" * 21), ("IMAGE", "ü" * 11)])
def test_names_that_are_too_long_are_refused(kind, device):
    with pytest.raises(InputError, match="OpenIGTLink: expected"):
        igtl_header.join(1, kind, device, None, Body(memoryview(b"")))


def test_numbers_that_are_none_are_refused():
    for number in (np.nan, np.inf, 1e30):
        with pytest.raises(InputError, match="finite"):
            igtl_header.finite(np.array([0.0, number]))
