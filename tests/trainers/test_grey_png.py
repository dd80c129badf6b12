"""PNGs are decoded as OpenCV does, and whatever is wrong with one is said once, in our words alone."""

import struct
import zlib

import cv2
import numpy as np
import pytest

pytest.importorskip("torch")  # the folder's fixtures are the trainers'

from recon.errors import InputError
from trainers.grey_png import decode


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(width: int, height: int, rows: bytes, header: bytes = b"\x08\0\0\0\0", more: bytes = b"") -> bytes:
    first = chunk(b"IHDR", struct.pack(">II", width, height) + header)
    return b"\x89PNG\r\n\x1a\n" + first + more + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


@pytest.mark.parametrize("level", [0, 1, 9])
def test_pixels_are_opencvs(rng, level):
    image = rng.integers(0, 255, (37, 53), np.uint8)
    data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, level])[1].tobytes()
    np.testing.assert_array_equal(decode("x", data, (53, 37)), image)


def test_other_programs_remarks_do_no_harm(capfd):
    """Chunks that libpng would complain of on the standard error."""
    more = chunk(b"iCCP", b"damaged") + chunk(b"gAMA", b"\xff" * 4) + chunk(b"tEXt", b"no end")
    assert decode("x", png(2, 1, b"\0\1\2", more=more), None).tolist() == [[1, 2]]
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (b"", "expected a PNG, found no data"),
        (b"\xff\xd8\xff", "expected a PNG, found damaged or other data"),
        (png(100_000, 100_000, b""), "expected a plain PNG of up to 67108864 px, found 100000x100000"),
        (png(0, 3, b""), "expected a plain PNG of up to 67108864 px, found 0x3"),
        (png(2, 1, b"\0\1\2", b"\x08\2\0\0\0"), "expected 8-bit grey, found 2x1 8-bit in colour"),
        (png(2, 1, b"\0\1\2\3\4", b"\x10\0\0\0\0"), "expected 8-bit grey, found 2x1 16-bit"),
        (png(2, 1, b"\0\1\2", b"\x08\0\0\0\1"), "found 2x1, interlaced or damaged"),
        (png(2, 1, b"\0\1\2", b"\x08\0\7\0\0"), "found 2x1, interlaced or damaged"),
        (png(2, 1, b"\0\1"), "found damaged data in its rows"),
        (png(2, 1, b"\0\1\2" * 1000), "found damaged data in its rows"),
        (png(2, 1, b"\7\1\2"), "found damaged data in its rows"),
        (png(2, 1, b"\0\1\2")[:-12], "expected a whole PNG image, found it cut short at"),
        (png(2, 1, b"\0\1\2").replace(b"IEND", b"IENC"), "expected a whole PNG image, found it cut short at"),
    ],
)
def test_damage_is_said_in_one_line_and_by_nobody_else(data, found, capfd):
    with pytest.raises(InputError, match=f"^here: .*{found}") as caught:
        decode("here", data, None)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


def test_rows_that_would_fill_the_memory_are_not_unpacked():
    """A megabyte of zeros, packed, claims two pixels."""
    with pytest.raises(InputError, match="damaged data in its rows"):
        decode("x", png(2, 1, bytes(1 << 27)), None)


def test_damage_at_random_is_refused_or_harmless(rng, capfd):
    """With checksums that fit, so that more than these is looked at."""
    data = cv2.imencode(".png", rng.integers(0, 255, (24, 32), np.uint8))[1].tobytes()
    refused = 0
    for _ in range(500):
        changed = bytearray(data)
        for place in rng.integers(8, len(data) if rng.random() < 0.5 else 60, 2):
            changed[place] = rng.integers(256)
        position = 8
        while position + 12 <= len(changed):
            end = position + 8 + struct.unpack_from(">I", changed, position)[0]
            changed[end : end + 4] = struct.pack(">I", zlib.crc32(changed[position + 4 : end]))
            position = end + 4
        try:
            decode("x", bytes(changed), None)
        except InputError:
            refused += 1
    assert refused > 300
    assert capfd.readouterr().err == ""
