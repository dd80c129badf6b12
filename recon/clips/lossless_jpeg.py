"""Lossless JPEG, as DICOM files have it: each sample is the sum of a prediction from its neighbours and a coded difference.

Source: ITU-T T.81, annexes B (markers), C and F.2.2.3 (Huffman codes) and H (prediction), of the process with codes of SOF3.
"""

import struct
from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.capture.image_formats import MOST_PX
from recon.compiled import njit

Codes = NDArray[np.uint16]  # (65536,) length and number of bits that follow, 256 length + bits, by the next 16 bits; 0: none

PREDICTORS = range(1, 8)
MOST_BITS = 16  # of a code, of a sample and of a difference


class Marker(IntEnum):
    """Second bytes of markers."""

    START = 0xD8
    FRAME = 0xC3  # of the lossless process with codes
    CODES = 0xC4
    SCAN = 0xDA
    RESTART_INTERVAL = 0xDD
    END = 0xD9


class _Frame(NamedTuple):
    """The image that the markers describe."""

    precision: int  # bits of a sample
    height: int
    width: int
    names: tuple[int, ...]  # of the components, such as red, green and blue


def decode(data: bytes) -> NDArray[np.uint16]:
    """Samples of an image : (h, w), or (h, w, components) of more than one.

    Raises
    ------
    ValueError
        If it is damaged, cut short, larger than images may be, or of another process of JPEG than the lossless one.
    """
    frame, codes, restart, samples = None, {}, 0, np.empty((0, 0, 0), np.uint16)
    seen = set()
    other_frames = (0xC0, 0xC1, 0xC2, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF)
    for marker, begin, end in _segments(data):
        content = data[begin:end]
        if marker in other_frames:
            raise ValueError(f"a JPEG image of another process, SOF{marker - 0xC0}, than the lossless one")
        if marker == Marker.FRAME:
            frame = _frame(content)
            samples = np.zeros((frame.height, frame.width, len(frame.names)), np.uint16)
        elif marker == Marker.CODES:
            codes |= _codes(content)
        elif marker == Marker.RESTART_INTERVAL:
            (restart,) = struct.unpack(">H", content)
        elif marker == Marker.SCAN:
            if frame is None:
                raise ValueError("a JPEG scan before its frame")
            places, tables, predictor, shift = _scan(content, frame, codes)
            if restart % frame.width:
                raise ValueError(f"a JPEG restart interval of {restart} samples, no whole rows of {frame.width}")
            part = np.zeros((frame.height, frame.width, len(places)), np.uint16)
            packed, first = np.frombuffer(data, np.uint8, offset=end), 1 << (frame.precision - shift - 1)
            if not _fill(packed, tables, predictor, first, restart // frame.width, part):
                raise ValueError("JPEG data that are damaged or cut short")
            samples[..., places] = part << shift
            seen.update(places)
    if frame is None or len(seen) < len(frame.names):
        raise ValueError("a JPEG image without all of its scans")
    return samples[..., 0] if len(frame.names) == 1 else samples


def _segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Markers with the begin and end of their contents; coded samples between them are passed over."""
    position = 2
    if data[:2] != bytes([0xFF, Marker.START]):
        raise ValueError("no JPEG image")
    while (position := data.find(b"\xff", position)) >= 0 and position + 4 <= len(data):
        marker = data[position + 1]
        if marker == Marker.END:
            return
        if marker in (0x00, 0x01, 0xFF, Marker.START) or 0xD0 <= marker <= 0xD7:
            position += 1 if marker == 0xFF else 2
            continue
        (length,) = struct.unpack(">H", data[position + 2 : position + 4])
        begin, end = position + 4, position + 2 + length
        if not begin <= end <= len(data):
            raise ValueError("a JPEG segment that is cut short")
        yield marker, begin, end
        position = end


def _frame(content: bytes) -> _Frame:
    precision, height, width, count = struct.unpack(">BHHB", content[:6])
    if not (2 <= precision <= MOST_BITS and 0 < height * width <= MOST_PX and count in (1, 3) and len(content) == 6 + 3 * count):
        raise ValueError(f"a JPEG frame of {width}x{height} px, {precision} bits and {count} components")
    if count > 1 and any(content[7 + 3 * k] != content[7] for k in range(count)):
        raise ValueError("JPEG components of different sizes")
    return _Frame(precision, height, width, tuple(content[6 + 3 * k] for k in range(count)))


def _codes(content: bytes) -> dict[int, Codes]:
    """Tables of codes by their numbers."""
    tables = {}
    while content:
        counts, name = content[1:17], content[0]
        symbols = content[17 : 17 + sum(counts)]
        if len(counts) < MOST_BITS or len(symbols) < sum(counts):
            raise ValueError("a JPEG table of codes that is cut short")
        table, code, used = np.zeros(1 << MOST_BITS, np.uint16), 0, 0
        for length in range(1, MOST_BITS + 1):
            span = 1 << (MOST_BITS - length)
            for symbol in symbols[used : used + counts[length - 1]]:
                if (code + 1) * span > len(table) or symbol > MOST_BITS:
                    raise ValueError("a JPEG table of codes that no code has")
                table[code * span : (code + 1) * span] = 256 * length + symbol
                code += 1
            used, code = used + counts[length - 1], 2 * code
        tables[name], content = table, content[17 + len(symbols) :]
    return tables


def _scan(content: bytes, frame: _Frame, codes: dict[int, Codes]) -> tuple[list[int], NDArray[np.uint16], int, int]:
    """Places of a scan's components in the frame, their tables : (components, 65536), the predictor, and the bits left out."""
    count = content[0] if content else 0
    if not 1 <= count <= len(frame.names) or len(content) != 4 + 2 * count:
        raise ValueError("a JPEG scan's header that is damaged")
    names, tables = content[1 : 1 + 2 * count : 2], [content[2 + 2 * k] >> 4 for k in range(count)]
    predictor, shift = content[1 + 2 * count], content[3 + 2 * count] & 15
    if not set(names) <= set(frame.names) or not set(tables) <= set(codes):
        raise ValueError("a JPEG scan of components or tables that aren't there")
    if predictor not in PREDICTORS or shift >= frame.precision:
        raise ValueError(f"JPEG predictor {predictor} of samples less {shift} bits")
    return [frame.names.index(name) for name in names], np.stack([codes[table] for table in tables]), predictor, shift


@njit
def _fill(packed, tables, predictor, first, rows, samples):
    """Decode a scan's samples : (h, w, components), which begin anew after each number of rows, if that is not 0.

    Returns False if the coded bits end before, or are no codes.
    """
    height, width, count = samples.shape
    position, waiting, held = 0, 0, 0  # bits that were read, and their number
    for y in range(height):
        if rows > 0 and y > 0 and y % rows == 0:
            held = 0
            while position + 1 < len(packed) and not (packed[position] == 0xFF and 0xD0 <= packed[position + 1] <= 0xD7):
                position += 1
            position += 2
        anew = y == 0 or (rows > 0 and y % rows == 0)
        for x in range(width):
            for c in range(count):
                held, waiting, position = _more(packed, position, waiting, held)
                code = np.int64(tables[c, (waiting >> (held - 16)) & 0xFFFF if held >= 16 else (waiting << (16 - held)) & 0xFFFF])
                length, bits = code >> 8, code & 255
                if length == 0 or length + (bits if bits < 16 else 0) > held:
                    return False
                held -= length
                step = 32768
                if bits < 16:
                    held -= bits
                    step = (waiting >> held) & ((1 << bits) - 1)
                    if bits > 0 and step < 1 << (bits - 1):
                        step += 1 - (1 << bits)
                waiting &= (1 << held) - 1
                samples[y, x, c] = (_predict(samples, y, x, c, anew, predictor, first) + step) & 0xFFFF
    return True


@njit(inline="always")
def _more(packed, position, waiting, held):
    """Bits that wait, at least 32 of them unless the scan's data end."""
    while held <= 32 and position < len(packed):
        byte = np.int64(packed[position])
        if byte == 0xFF:
            if position + 1 >= len(packed) or packed[position + 1] != 0:
                break
            position += 1
        position += 1
        waiting = (waiting << 8) | byte
        held += 8
    return held, waiting, position


@njit(inline="always")
def _predict(samples, y, x, c, anew, predictor, first):
    """A sample by those to its left, above and between."""
    if anew:
        return first if x == 0 else np.int64(samples[y, x - 1, c])
    above = np.int64(samples[y - 1, x, c])
    if x == 0:
        return above
    left, between = np.int64(samples[y, x - 1, c]), np.int64(samples[y - 1, x - 1, c])
    if predictor == 1:
        return left
    if predictor == 2:
        return above
    if predictor == 3:
        return between
    if predictor == 4:
        return left + above - between
    if predictor == 5:
        return left + ((above - between) >> 1)
    if predictor == 6:
        return above + ((left - between) >> 1)
    return (left + above) >> 1
