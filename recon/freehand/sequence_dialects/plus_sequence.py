"""Sequences of the PLUS toolkit and 3D Slicer: MetaImage, NRRD and Matroska, with texts for each frame."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.files import matroska, medical_images
from recon.files.medical_images import ImageFile
from recon.files.regular import opened
from recon.freehand import sequence_images
from recon.freehand.sequences import FRAME_FIELD, STRUCTURE, Array, Frames, frame_key, is_usable
from recon.model import pose_checks

MOST_EMPTY, FEW_FRAMES = 10, 10_000  # times the fields that are there, which all frames may lack; frames of a file without any
STARTS = (b"NRRD", b"ObjectType", matroska.START)


def recognises(path: Path) -> bool:
    """Whether it begins as one of the three does."""
    with opened(path) as stream:
        return stream.read(max(map(len, STARTS))).startswith(STARTS)


def read_tracking(path: Path) -> Frames:
    """Read it without its images."""
    return _without_images(medical_images.read_header(path))


def image_shape(path: Path) -> tuple[int, int] | None:
    """Height and width of its images; None of tracking alone."""
    file = medical_images.read_header(path)
    return sequence_images.turned_shape(file) if sequence_images.has_images(file) else None


def images(path: Path) -> Iterator[NDArray[np.uint8]]:
    """Its images (h, w), one by one."""
    file = medical_images.read_header(path)
    return sequence_images.images(file) if sequence_images.has_images(file) else iter(())


def _without_images(file: ImageFile) -> Frames:
    count = sequence_images.layout(file).count
    fields = {name: value for name, value in file.fields.items() if not FRAME_FIELD.fullmatch(name)}
    kept = {name: value for name, value in fields.items() if name not in STRUCTURE}
    table = _frame_table(file, count)
    transforms, valid = {}, {}
    status = table.pop("ImageStatus", table.pop("Status", [""] * count))
    if sequence_images.has_images(file):
        valid["Image"] = np.array([word.upper() in ("", "OK") for word in status])
    for key in [key for key in table if key.endswith("Transform")]:
        name = key.removesuffix("Transform")
        texts, words = table.pop(key), table.pop(key + "Status", [""] * count)
        transforms[name], valid[name] = _matrices(file, key, texts, words)
        if any(word.upper() not in ("", "OK", "INVALID") for word in words):
            table[key + "Status"] = words
    times = np.array([_time(file, index, text) for index, text in enumerate(table.pop("Timestamp", [""] * count))])
    return Frames(times, transforms, valid, None, {name: tuple(texts) for name, texts in table.items()}, kept)


def _frame_table(file: ImageFile, count: int) -> dict[str, list[str]]:
    table: dict[str, list[str]] = {}
    names = {match[2] for name in file.fields if (match := FRAME_FIELD.fullmatch(name))}
    if (len(names) + 1) * count > MOST_EMPTY * (len(file.fields) + FEW_FRAMES):
        raise file.fault("DimSize", f"frames of which most have fields, as {len(file.fields)} are there", f"{count} frames")
    for name, text in file.fields.items():
        if match := FRAME_FIELD.fullmatch(name):
            if int(match[1]) >= count:
                raise file.fault(name, f"frames below {count}, their number", match[1])
            table.setdefault(match[2], [""] * count)[int(match[1])] = text
    return table


def _matrices(file: ImageFile, key: str, texts: list[str], words: list[str]) -> tuple[Array, NDArray[np.bool_]]:
    matrices, valid = np.tile(np.eye(4), (len(texts), 1, 1)), np.zeros(len(texts), bool)
    for index, (text, word) in enumerate(zip(texts, words, strict=True)):
        if not text:
            continue
        name = frame_key(index, key)
        matrix = medical_images.numbers(file.path, name, text, 16).reshape(4, 4)
        lost = pose_checks.is_lost(matrix)
        valid[index] = word.upper() in ("", "OK") and not lost
        if valid[index] and not is_usable(matrix):
            raise file.fault(name, "an invertible matrix with the last row 0 0 0 1", repr(text))
        matrices[index] = np.eye(4) if lost else matrix
    return matrices, valid


def _time(file: ImageFile, index: int, text: str) -> float:
    return float(medical_images.numbers(file.path, frame_key(index, "Timestamp"), text, 1)[0]) if text else np.nan
