"""PNG images, decoded whole or refused in one line.

OpenCV's library writes lines of its own to the console where a file is damaged or merely odd, and returns images that are partly
black. Here chunks that pixels aren't made of are left alone, and the others are checked one by one.

Source: W3C, Portable Network Graphics, third edition.
"""

import struct
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel
from recon.errors import InputError

Pixels = NDArray[np.uint8] | NDArray[np.uint16]

SIGNATURE = b"\x89PNG\r\n\x1a\n"
HEADER_BYTES = 13
PARTS = (b"IHDR", b"PLTE", b"IDAT", b"IEND")
CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # numbers a pixel, by the kind of colour
DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}  # bits a number
GREY, PALETTE = (0, 4), 3  # kinds of colour
SUB, UP, AVERAGE, PAETH = 1, 2, 3, 4  # filters of a row; 0 is none


class Header(NamedTuple):
    """The header of a file."""

    width: int  # px
    height: int
    depth: int  # bits a number
    colour: int  # a key of CHANNELS
    packing: int
    filtering: int
    interlaced: int

    @property
    def row_bytes(self) -> int:
        """Length of a row, with the byte of its filter."""
        return 1 + -(-self.width * CHANNELS[self.colour] * self.depth // 8)


def decode(path: Path, data: bytes, most_px: int) -> Pixels:
    """Pixels of a PNG file : (h, w) grey or (h, w, 3) blue, green, red; what they cover is left out.

    Parameters
    ----------
    most_px : pixels that it may have

    Raises
    ------
    InputError
        If it is cut short, damaged, interlaced or larger.
    """
    header, chunks = _chunks(path, data, most_px)
    stream = b"".join(content for kind, content in chunks if kind == b"IDAT")
    rows = _rows(path, stream, header)
    if (most := rows[:, 0].max()) > PAETH:
        raise InputError(f"{path}: expected a whole PNG image, found a filter {most}: damaged data")
    if rows[:, 0].any():
        rows = rows.copy()
        unfilter(rows, max(CHANNELS[header.colour] * header.depth // 8, 1))
    values = np.ascontiguousarray(rows[:, 1:])
    if header.colour == PALETTE:
        return _coloured(path, _whole_bytes(values, header), chunks)
    if header.depth < 8:
        return _whole_bytes(values, header) * np.uint8(255 // ((1 << header.depth) - 1))
    if header.depth == 16:
        values = values.view(">u2").astype(np.uint16)
    pixels = values.reshape(header.height, header.width, CHANNELS[header.colour])
    return np.ascontiguousarray(pixels[..., 0] if header.colour in GREY else pixels[..., 2::-1])


@kernel
def unfilter(rows, step):
    """Turn the bytes of rows : (h, 1 + n) uint8 from differences into values; `step` bytes lie between those of a pixel."""
    for y in range(rows.shape[0]):
        kind = rows[y, 0]
        for x in range(1, rows.shape[1]):
            left = np.int32(rows[y, x - step]) if x > step else np.int32(0)
            up = np.int32(rows[y - 1, x]) if y else np.int32(0)
            if kind == SUB:
                rows[y, x] += np.uint8(left)
            elif kind == UP:
                rows[y, x] += np.uint8(up)
            elif kind == AVERAGE:
                rows[y, x] += np.uint8((left + up) // 2)
            elif kind == PAETH:
                before = np.int32(rows[y - 1, x - step]) if y and x > step else np.int32(0)
                to_left, to_up, to_before = abs(up - before), abs(left - before), abs(left + up - 2 * before)
                nearest = left if to_left <= to_up and to_left <= to_before else up if to_up <= to_before else before
                rows[y, x] += np.uint8(nearest)


def _whole_bytes(values: NDArray[np.uint8], header: Header) -> NDArray[np.uint8]:
    """Numbers : (h, w) that lie packed in bytes : (h, n), the first in the uppermost bits."""
    bits = np.unpackbits(values, axis=1)[:, : header.width * header.depth].reshape(header.height, header.width, header.depth)
    return np.packbits(bits, axis=2)[..., 0] >> (8 - header.depth)


def _coloured(path: Path, indices: NDArray[np.uint8], chunks: list[tuple[bytes, memoryview]]) -> Pixels:
    palette = next((content for kind, content in chunks if kind == b"PLTE"), b"")
    colours = np.frombuffer(palette, np.uint8, len(palette) // 3 * 3).reshape(-1, 3)
    if indices.max() >= len(colours):
        raise InputError(f"{path}: expected a palette of {indices.max() + 1} colours or more, found {len(colours)}: damaged data")
    return colours[:, ::-1][indices]


def _chunks(path: Path, data: bytes, most_px: int) -> tuple[Header, list[tuple[bytes, memoryview]]]:
    """Header and chunks that pixels are made of; refused if the file is cut short, or a checksum doesn't fit."""
    view, position, kind = memoryview(data), len(SIGNATURE), b""
    chunks = []
    while kind != b"IEND":
        if position + 12 > len(data):
            raise InputError(f"{path}: expected a whole PNG image, found it cut short at {len(data)} bytes")
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 8 + length
        if end + 4 > len(data):
            raise InputError(f"{path}: expected a whole PNG image, found it cut short at {len(data)} bytes")
        if zlib.crc32(view[position + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise InputError(f"{path}: expected a whole PNG image, found damaged data at byte {position}")
        if kind in PARTS:
            chunks.append((kind, view[position + 8 : end]))
        position = end + 4
    if chunks[0][0] != b"IHDR" or len(chunks[0][1]) != HEADER_BYTES:
        raise InputError(f"{path}: expected a PNG image, found no header in it")
    header = Header(*struct.unpack(">IIBBBBB", chunks[0][1]))
    if not 0 < header.width * header.height <= most_px:
        raise InputError(f"{path}: expected an image of up to {most_px} px, found {header.width}x{header.height}")
    if header.depth not in DEPTHS.get(header.colour, ()) or header.packing or header.filtering or header.interlaced > 1:
        raise InputError(f"{path}: expected a PNG image, found a damaged header")
    if header.interlaced:
        raise InputError(f"{path}: expected a PNG image row by row, found an interlaced one: save it without")
    return header, chunks


def _rows(path: Path, stream: bytes, header: Header) -> NDArray[np.uint8]:
    """Unpacked rows : (h, n), each with the byte of its filter."""
    wanted = header.row_bytes * header.height
    try:
        rows = zlib.decompressobj().decompress(stream, wanted)
    except zlib.error:
        rows = b""
    if len(rows) < wanted:
        raise InputError(f"{path}: expected a whole PNG image, found {len(rows)} bytes of {wanted}: damaged data")
    return np.frombuffer(rows, np.uint8, wanted).reshape(header.height, -1)
