"""Matrices from MATLAB's files, version 5 to 7: read whole and checked, or refused in one line.

SciPy's reader knows more kinds of content, but files damaged at random make it end the process. Read here are arrays of real
numbers, which is all that calibrations need.

Source: MathWorks, MAT-File Level 5 File Format.
"""

import struct
import zlib
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.files.npz import Form, check_forms
from recon.files.regular import opened, read_bytes

Buffer = bytes | memoryview

TAG = 8  # bytes, of an element's type and size
ORDERS = {b"IM": "<", b"MI": ">"}
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}  # by type of an element
MATRIX, COMPRESSED = 14, 15  # types of elements
NUMERIC = range(6, 16)  # classes of arrays
OBJECTS = (3, 17)
COMPLEX = 0x800  # in an array's flags
HEAD = 1 << 12  # bytes within which an array's flags, shape and name stand


def is_matlab(path: Path) -> bool:
    """Whether a file is one of MATLAB's, by its first bytes; raises InputError if it can't be read."""
    begin = b"MATLAB "  # of the header's text, in all versions from 5 on
    with opened(path) as stream:
        return stream.read(len(begin)) == begin


def read(path: Path, forms: Mapping[str, Form], other_names: Mapping[str, str]) -> dict[str, NDArray]:
    """Read named matrices; others in the file are left alone.

    Parameters
    ----------
    other_names : old name -> name that stands in `forms`

    Raises
    ------
    InputError
        If the file is damaged, of version 7.3, holds objects in place of matrices, or one is missing, too large or of another
        form.
    """
    data = read_bytes(path)
    hdf5 = b"MATLAB 7.3"  # a file of another kind
    if data.startswith(hdf5):
        raise InputError(f"{path}: expected a MATLAB file of version 5 to 7, found 7.3: save it with -v7")
    arrays, objects = {}, False
    header = 128  # bytes, the order of bytes in the last two
    most = 1 << 24  # bytes, of a matrix that is read
    try:
        order = ORDERS[data[header - 2 : header]]
        for element in _elements(memoryview(data)[header:], order):
            size, head = _unpack(*element, order, HEAD)
            kind, name = _described(head, order)
            objects |= kind in OBJECTS
            name = other_names.get(name, name)
            if name not in forms:
                continue
            if size > most:
                raise InputError(f"{path}: {name}: expected a matrix of up to {most >> 20} MiB, found {-(-size >> 20)} MiB")
            arrays[name] = _matrix(_unpack(*element, order, size)[1], order)
    except InputError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, StopIteration, struct.error, zlib.error):
        raise InputError(f"{path}: expected a MATLAB file of version 5 to 7, found damaged data") from None
    if objects and not forms.keys() & arrays.keys():
        raise InputError(f"{path}: expected matrices {', '.join(forms)}, found a MATLAB object: save its matrices by these names")
    arrays = {name: arrays[name] for name in forms if name in arrays}
    check_forms(path, arrays, forms)
    return arrays


def _unpack(kind: int, content: Buffer, order: str, most: int) -> tuple[int, Buffer]:
    """Bytes of the array in an element, and the first ones of them, unpacked if need be; 0 and none of anything else."""
    if kind != COMPRESSED:
        return (len(content), content[:most]) if kind == MATRIX else (0, b"")
    unpacked = zlib.decompressobj().decompress(content, TAG + most)
    kind, size = struct.unpack_from(f"{order}II", unpacked)
    return (size, unpacked[TAG : TAG + size]) if kind == MATRIX else (0, b"")


def _described(head: Buffer, order: str) -> tuple[int, str]:
    """Class and name of an array by its beginning; the name is empty if it doesn't hold real numbers, or isn't one."""
    if not head:
        return 0, ""
    elements = _elements(head, order)
    flags = int(_numbers(*next(elements), order)[0])
    if flags & 0xFF not in NUMERIC or flags & COMPLEX:
        return flags & 0xFF, ""
    next(elements)  # the shape
    return flags & 0xFF, bytes(next(elements)[1]).decode("ascii")


def _matrix(content: Buffer, order: str) -> NDArray:
    """Numbers of an array."""
    _, shape, _, numbers = islice(_elements(content, order), 4)
    return _numbers(*numbers, order).reshape(_numbers(*shape, order).tolist(), order="F")


def _numbers(kind: int, content: Buffer, order: str) -> NDArray:
    return np.frombuffer(content, np.dtype(NUMBERS[kind]).newbyteorder(order))


def _elements(data: Buffer, order: str) -> Iterator[tuple[int, Buffer]]:
    """Types and contents of the elements that follow each other; ValueError if one is cut short."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        begin, small = at + TAG, kind >> 16
        if small:  # up to four bytes lie in the tag itself
            kind, size, begin = kind & 0xFFFF, small, at + 4
        if begin + size > len(data) or small > 4:
            raise ValueError("an element is cut short")
        yield kind, data[begin : begin + size]
        at = begin + size if kind == COMPRESSED else begin + -(-size // 8) * 8 if not small else at + TAG
