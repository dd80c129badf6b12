"""OpenIGTLink's frame about a message: the header, the metadata of protocol 3, the time stamp and the checksum.

Source: the protocol's specification, version 3.0 of 2017 (header versions 1 and 2). All numbers are big-endian.
"""

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel
from recon.errors import InputError, short

HEADER = struct.Struct(">H12s20sQQQ")  # version, kind, device, time, size of the body, checksum of the body
EXTENDED = struct.Struct(">HHII")  # its own size, sizes of the metadata's index and content, number of the message
ENTRY = struct.Struct(">HHI")  # length of the key, encoding and length of the value
ENCODINGS = {3: "ascii", 4: "latin-1", 106: "utf-8"}  # numbers of the IANA character sets
ASCII, UTF8 = 3, 106
SECOND = 10**9  # ns
MOST_NAME_BYTES = 20  # of a device
MOST_BODY_BYTES = 64 << 20  # a volume of 64 MB; a live image has less than 10
KIND = re.compile(rb"[A-Za-z0-9_]{1,12}\0*")


@dataclass(frozen=True)
class Header:
    """The first 58 bytes of a message."""

    version: int
    kind: str  # IMAGE, TRANSFORM, GET_STATUS
    device: str  # by which a receiver names the content: Image, ProbeToTracker
    time_ns: int | None  # since 1970, UTC; None where the sender gives none
    size: int  # of the body, bytes
    checksum: int

    @property
    def name(self) -> str:
        """The message's name in lines for people."""
        return f"{self.kind} of {short(self.device)!r}"


@dataclass(frozen=True)
class Body:
    """A body in its parts."""

    content: memoryview
    number: int = 0  # of the message, which protocol 3 has
    metadata: Mapping[str, str] = field(default_factory=dict)


def read_header(data: bytes, most_bytes: int = MOST_BODY_BYTES) -> Header:
    """Read the first 58 bytes of a message.

    Raises
    ------
    InputError
        If they are none of a message, or announce a body of more bytes than `most_bytes`.
    """
    version, kind, device, time, size, checksum = HEADER.unpack(data)
    versions = (1, 2)  # of the header: protocols 1 and 2 write 1, protocol 3 writes 2
    if version not in versions or not KIND.fullmatch(kind):
        raise InputError(f"header: expected one of OpenIGTLink, version 1 or 2, found {short(repr(data[:14]))}")
    header = Header(version, text(kind), text(device, UTF8), nanoseconds(time) if time else None, size, checksum)
    if size > most_bytes:
        raise InputError(f"{header.name}: expected a body of at most {most_bytes} bytes, found one of {size}")
    return header


def checked(header: Header, body: bytes) -> bytes:
    """The body, if it is the one that the header was written for; InputError if not."""
    if (found := crc64(body)) != header.checksum:
        cause = "a damaged message" if header.checksum else "a sender without checksums? give check=False"
        raise InputError(f"{header.name}: expected the checksum {header.checksum:016x}, found {found:016x}: {cause}")
    return body


def split(header: Header, body: bytes) -> Body:
    """Part a body into content and metadata.

    Raises
    ------
    InputError
        If the parts' sizes contradict the body's.
    """
    if header.version == 1:
        return Body(memoryview(body))
    if len(body) < EXTENDED.size:
        raise _fault(header, f"an extended header of {EXTENDED.size} bytes", f"a body of {len(body)}")
    start, index_size, values_size, number = EXTENDED.unpack_from(body)
    end = len(body) - index_size - values_size
    if not EXTENDED.size <= start <= end:
        found = f"{start}, {index_size} and {values_size} bytes in a body of {len(body)}"
        raise _fault(header, "an extended header and metadata that the body has room for", found)
    index, values = memoryview(body)[end : end + index_size], memoryview(body)[end + index_size :]
    return Body(memoryview(body)[start:end], number, _metadata(header, index, values))


def join(version: int, kind: str, device: str, time_ns: int | None, body: Body) -> bytes:
    """Write a message; a header of version 1 leaves number and metadata out.

    Raises
    ------
    InputError
        If the kind has more than 12 letters, the device's name more than 20 bytes, or the time lies outside 1970 to 2106.
    """
    name = device.encode()
    if not KIND.fullmatch(kind.encode()):
        raise InputError(f"OpenIGTLink: expected a kind of 1 to 12 letters, found {short(kind)!r}")
    if len(name) > MOST_NAME_BYTES:
        expected = f"a device's name of at most {MOST_NAME_BYTES} bytes"
        raise InputError(f"OpenIGTLink: expected {expected}, found {short(device)!r} of {len(name)}")
    whole = bytes(body.content) if version == 1 else _extend(body)
    return HEADER.pack(version, kind.encode(), name, fixed_point(time_ns), len(whole), crc64(whole)) + whole


def fixed_point(time_ns: int | None) -> int:
    """A time since 1970 as seconds with 32 bits before and after the point; 0 is none."""
    if time_ns is None:
        return 0
    last_second = 2**32  # since 1970; the field ends in 2106
    if not 0 <= time_ns < last_second * SECOND:
        raise InputError(f"OpenIGTLink: expected a time of 1970 to 2106, found {time_ns} ns since 1970")
    seconds, rest = divmod(time_ns, SECOND)
    return (seconds << 32) + (rest << 32) // SECOND  # one of 4.3e9 parts is shorter than 1 ns: it reads back


def nanoseconds(time: int) -> int:
    """A time stamp as ns since 1970, rounded."""
    return (time >> 32) * SECOND + (((time & 0xFFFFFFFF) * SECOND + (1 << 31)) >> 32)


def text(data: bytes | memoryview, encoding: int = ASCII) -> str:
    """A text of any length up to its first zero; what isn't in its encoding is replaced."""
    return bytes(data).partition(b"\0")[0].decode(ENCODINGS.get(encoding, "utf-8"), "replace")


def encoded(value: str) -> tuple[int, bytes]:
    """A text in ASCII, or in UTF-8 where it has other letters: the encoding's number, and its bytes."""
    return (ASCII if value.isascii() else UTF8), value.encode()


def finite(numbers: NDArray) -> NDArray[np.float64]:
    """Numbers of a message, if all are some; InputError if not: what is none comes from senders that have no pose."""
    farthest_mm = 1e9
    if not (np.abs(numbers) < farthest_mm).all():
        raise InputError(f"expected finite numbers below {farthest_mm:g}, found {short(str(numbers.ravel()[:12].tolist()))}")
    return numbers.astype(float)


def crc64(data: bytes) -> int:
    """Checksum of ECMA-182: the polynomial 0x42f0e1eba9ea3693, the highest bit first, from 0."""
    found = np.zeros(1, np.uint64)
    _divide(np.frombuffer(data, np.uint8), TABLES, found)
    return int(found[0])


def _tables() -> NDArray[np.uint64]:
    """Remainders of a byte that is followed by 0 to 7 zero bytes : (8, 256)."""
    tables = np.zeros((8, 256), np.uint64)
    for byte in range(256):
        rest = byte << 56
        for zeros in range(8):
            for _ in range(8):
                rest = (rest << 1 ^ (0x42F0E1EBA9EA3693 if rest >> 63 else 0)) & 0xFFFFFFFFFFFFFFFF
            tables[zeros, byte] = rest
    return tables


TABLES = _tables()


@kernel
def _divide(data, tables, found):
    """Remainder of the division, eight bytes at once: a table for each of their places."""
    rest, n = found[0], 0
    while n + 8 <= data.size:
        after = np.uint64(0)
        for place in range(8):
            byte = data[n + place] ^ np.uint8(rest >> np.uint64(56 - 8 * place))
            after ^= tables[7 - place, byte]
        rest, n = after, n + 8
    for k in range(n, data.size):
        rest = tables[0, data[k] ^ np.uint8(rest >> np.uint64(56))] ^ (rest << np.uint64(8))
    found[0] = rest


def _extend(body: Body) -> bytes:
    """A body with extended header and metadata."""
    entries = [(key.encode(), *encoded(value)) for key, value in body.metadata.items()]
    index = struct.pack(">H", len(entries)) + b"".join(ENTRY.pack(len(key), code, len(value)) for key, code, value in entries)
    values = b"".join(key + value for key, _, value in entries)
    return EXTENDED.pack(EXTENDED.size, len(index), len(values), body.number) + body.content + index + values


def _metadata(header: Header, index: memoryview, values: memoryview) -> dict[str, str]:
    """Keys and values; keys may come in any order, the last of a name counts."""
    if not index:
        return {}
    count = int.from_bytes(index[:2])
    most_entries = 1000  # of the metadata
    if count > most_entries or len(index) < 2 + count * ENTRY.size:
        raise _fault(header, f"metadata of {len(index)} bytes with at most {most_entries} entries", f"{count}")
    found, at = {}, 0
    for key_size, code, value_size in ENTRY.iter_unpack(index[2 : 2 + count * ENTRY.size]):
        middle, end = at + key_size, at + key_size + value_size
        if end > len(values):
            raise _fault(header, f"metadata of {len(values)} bytes", f"{end}")
        found[text(values[at:middle], UTF8)] = text(values[middle:end], code)
        at = end
    return found


def _fault(header: Header, expected: str, found: str) -> InputError:
    return InputError(f"{header.name}: expected {expected}, found {found}")
