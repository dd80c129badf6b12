"""Faults of arrays, meshes and volumes: shapes, counts and header fields that contradict the numbers."""

import io
import re
import struct
import zipfile
from collections.abc import Iterator

import numpy as np

from campaign.byte_faults import Content, cut_faults
from campaign.text_faults import DIGITS


def npz_faults(content: bytes) -> Iterator[tuple[str, Content]]:
    """Arrays that are missing, of objects, of other shapes, not finite, declared larger than all memory."""
    with np.load(io.BytesIO(content)) as file:
        arrays = {name: file[name] for name in file.files}
    first = next(iter(arrays))
    yield "half", content[: len(content) // 2]
    yield "no arrays", _npz({})
    yield "objects to unpickle", _npz(dict.fromkeys(arrays, np.array([{}], object)))
    yield "one number each", _npz(dict.fromkeys(arrays, np.zeros(1)))
    yield "words", _npz(dict.fromkeys(arrays, np.array(["many"])))
    yield "complex numbers", _npz({name: np.full(np.shape(array), 1j) for name, array in arrays.items()})
    yield "not a number", _npz({name: np.full(np.shape(array), np.nan) for name, array in arrays.items()})
    yield f"{first} declared huge", _npz_of({f"{first}.npy": _npy_header("(99999999, 99999999)")})
    yield f"{first} of a negative shape", _npz_of({f"{first}.npy": _npy_header("(-1, 3)")})
    yield "texts", _npz_of({f"{name}.npy": b"text" for name in arrays})
    yield f"{first} unpacks to 4 GB", lambda: _npz_of({f"{first}.npy": _npy_header("(536870912,)")}, zeros=1 << 32)


def _npz(arrays: dict) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def _npz_of(members: dict[str, bytes], zeros: int = 0) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            with archive.open(name, "w", force_zip64=True) as member:
                member.write(content)
                for _ in range(zeros >> 24):
                    member.write(bytes(1 << 24))
    return file.getvalue()


def _npy_header(shape: str) -> bytes:
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}"
    text += " " * (-(len(text) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text.encode()


def ply_faults(content: bytes) -> Iterator[tuple[str, bytes]]:
    """Counts that aren't true, indices of no vertex, vertices that are nowhere."""
    end = content.index(b"end_header\n") + 11
    header, data = content[:end], bytearray(content[end:])
    yield "half", content[: len(content) // 2]
    yield "no end of the header", content[: end - 11]
    yield "billions of vertices", re.sub(rb"element vertex \d+", b"element vertex 4000000000", content, count=1)
    yield "-1 vertices", re.sub(rb"element vertex \d+", b"element vertex -1", content, count=1)
    yield "an unknown type", content.replace(b"property float", b"property quaternion", 1)
    nowhere = data.copy()
    nowhere[:12] = struct.pack("<3f", *[float("nan")] * 3)
    yield "a vertex that is nowhere", header + bytes(nowhere)
    wrong = data.copy()
    wrong[-4:] = struct.pack("<i", 2_000_000_000)
    yield "a face of no vertex", header + bytes(wrong)


def mha_faults(content: bytes) -> Iterator[tuple[str, bytes]]:
    """Header fields of MetaImage sequences that contradict the pixels or themselves."""
    yield from cut_faults(content)
    yield from _header_faults(
        content,
        {
            b"DimSize": [b"0 0 0", b"99999999 99999999 99999999", b"-1 2 3", b"many", DIGITS.encode(), b"1e3 1 1"],
            b"NDims": [b"99", b"-1", b"many", DIGITS.encode()],
            b"ElementType": [b"MET_UNKNOWN", b"MET_DOUBLE_ARRAY"],
            b"CompressedDataSize": [b"5", b"99999999999999"],
            b"ElementDataFile": [b"/dev/zero", b"../../../etc/passwd", b"nowhere.raw"],
        },
    )
    transform = next(re.finditer(rb"(Seq_Frame\d+_\w+Transform) = ([^\n]*)", content))
    for name, value in (("three numbers", b"1 2 3"), ("words", b"x " * 16)):
        yield f"a transform of {name}", content.replace(transform[0], transform[1] + b" = " + value, 1)


def nrrd_faults(content: bytes) -> Iterator[tuple[str, bytes]]:
    """Header fields of NRRD volumes that contradict the pixels or themselves."""
    yield from cut_faults(content)
    yield from _header_faults(
        content,
        {
            b"sizes": [b"0 0 0", b"99999999 99999999 99999999", b"-1 2 3", b"many", DIGITS.encode()],
            b"dimension": [b"99", b"many"],
            b"type": [b"quaternion"],
            b"encoding": [b"unknown"],
            b"space directions": [b"(0,0,0) (0,0,0) (0,0,0)", b"(nan,0,0) (0,1,0) (0,0,1)", b"many"],
            b"space origin": [b"(nan,nan,nan)", b"(1e308,1e308,1e999)"],
        },
        separator=b":",
    )


def _header_faults(content: bytes, values: dict[bytes, list[bytes]], separator: bytes = b" =") -> Iterator[tuple[str, bytes]]:
    for field, nonsense in values.items():
        for value in nonsense:
            pattern = rb"^" + re.escape(field + separator) + rb"[^\n]*"
            changed = re.sub(pattern, field + separator + b" " + value, content, count=1, flags=re.MULTILINE)
            if changed != content:
                yield f"{field.decode()} is {value[:30].decode()}", changed
