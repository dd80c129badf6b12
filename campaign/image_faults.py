"""Faults of images: other sizes, sizes beyond all memory, damage within."""

import struct
import zlib
from collections.abc import Iterator

import cv2
import numpy as np


def png_faults(content: bytes) -> Iterator[tuple[str, bytes]]:
    """Another size, declared sizes beyond all memory, damage within."""
    image = np.asarray(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED))
    yield "half", content[: len(content) // 2]
    yield "another size", _png(image[:-8, :-8])
    yield "a hundred thousand px wide", _with_chunk(content, b"IHDR", struct.pack(">II", 100_000, 100_000) + content[24:29])
    yield "two billion px wide", _with_chunk(content, b"IHDR", struct.pack(">II", 2**31 - 1, 2**31 - 1) + content[24:29])
    yield "no px wide", _with_chunk(content, b"IHDR", struct.pack(">II", 0, 0) + content[24:29])
    yield "an unknown depth", _with_chunk(content, b"IHDR", content[16:24] + bytes([7]) + content[25:29])
    spoilt = bytearray(content)
    spoilt[len(content) // 2] ^= 0xFF
    yield "a byte spoilt", bytes(spoilt)
    yield "fewer rows than declared", _with_chunk(content, b"IDAT", zlib.compress(bytes((image.shape[1] + 1) * 10)))
    yield "a text instead", b"P5\n99999999 99999999\n255\n"
    sides = b"".join(struct.pack("<HHII", tag, 4, 1, 2**31 - 1) for tag in (256, 257))  # width and height
    yield "a TIFF of a huge size", struct.pack("<2sHIH", b"II", 42, 8, 2) + sides + bytes(4)


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def _with_chunk(content: bytes, kind: bytes, data: bytes) -> bytes:
    """A PNG whose first chunk of a kind has other data, and a right checksum; further ones of the kind go."""
    out, place, done = content[:8], 8, False
    while place < len(content):
        (length,) = struct.unpack(">I", content[place : place + 4])
        name = content[place + 4 : place + 8]
        if name != kind:
            out += content[place : place + 12 + length]
        elif not done:
            out += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
            done = True
        place += 12 + length
    return out
