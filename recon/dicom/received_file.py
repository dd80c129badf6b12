"""DICOM objects that come from others: read whole and uncompressed, of the class that is meant, or refused in one line."""

import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray
from pydicom import dcmread
from pydicom.dataelem import RawDataElement
from pydicom.dataset import Dataset
from pydicom.errors import InvalidDicomError
from pydicom.filereader import read_dataset
from pydicom.uid import UID, ExplicitVRLittleEndian, ImplicitVRLittleEndian

from recon.clips.dialects.dicom_clip import DAMAGED, META, PREAMBLE, PREFIX
from recon.errors import InputError, reason, short
from recon.files.regular import opened

Array = NDArray[np.float64]

MOST_BYTES = 1 << 32
UNDEFINED = 0xFFFFFFFF  # a length that the content tells
PLAIN = (ExplicitVRLittleEndian, ImplicitVRLittleEndian)
FARTHEST_MM = 1e6
SAME_MM = 0.01  # places that count as one
MOST_ITEMS = 100_000  # frames, segments, surfaces


@contextmanager
def refusing(path: Path, expected: str) -> Iterator[None]:
    """Turn what pydicom and NumPy raise on damaged content into one line."""
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except DAMAGED as error:
        raise InputError(f"{path}: expected {expected}, found it damaged: {reason(error)}") from None


def read(path: Path, sop_class: UID, expected: str) -> Dataset:
    """Read an object of a class.

    Raises
    ------
    InputError
        If the file is missing, no DICOM, damaged, compressed, or of another class.
    """
    with refusing(path, expected), opened(path, MOST_BYTES, expected) as stream:
        _check_syntax(path, stream)
        stream.seek(0)
        one = dcmread(stream)
        for tag in one.keys():
            element = one.get_item(tag)
            if isinstance(element, RawDataElement) and element.length not in (UNDEFINED, len(element.value or b"")):
                raise EOFError(f"{len(element.value or b'')} of {element.length} bytes at its end")  # pydicom takes what is there
        if one.get("SOPClassUID") != sop_class:
            found = one.get("SOPClassUID")
            raise fault(path, "SOPClassUID", f"{sop_class.name}", "none" if found is None else short(UID(str(found)).name))
        return one


def _check_syntax(path: Path, stream: BinaryIO) -> None:
    """InputError for what is compressed; before it is read, as a file that is packed as a whole may unpack to any size."""
    stream.seek(PREAMBLE)
    if stream.read(len(PREFIX)) != PREFIX:
        raise InvalidDicomError(f"no {PREFIX.decode()} at byte {PREAMBLE}")
    meta = read_dataset(stream, is_implicit_VR=False, is_little_endian=True, stop_when=lambda tag, *_: tag.group != META)
    syntax = meta.get("TransferSyntaxUID")
    if syntax not in PLAIN:
        name = "none" if syntax is None else short(UID(syntax).name)
        expected = "expected uncompressed data, little endian"
        raise InputError(f"{path}: TransferSyntaxUID: {expected}, found {name}; gdcmconv --raw undoes compression")


def fault(path: Path, field: str, expected: str, found: object) -> InputError:
    """A refusal, by the field of the standard."""
    return InputError(f"{path}: {field}: expected {expected}, found {short(str(found))}")


def numbers(path: Path, field: str, values: Iterable[object], count: int) -> Array:
    """Finite numbers : (count,) that are near enough for places; InputError."""
    found = np.array([float(value) for value in values], float)  # type: ignore[arg-type]
    if found.shape != (count,) or not (np.abs(found) < FARTHEST_MM).all():
        raise fault(path, field, f"{count} finite numbers below {FARTHEST_MM:g}", found)
    return found


def check_frame(path: Path, one: Dataset, frame_of_reference: str | None) -> None:
    """InputError if an object lies in another frame than the one that it is to be laid over."""
    if frame_of_reference is not None and one.get("FrameOfReferenceUID") != frame_of_reference:
        found = one.get("FrameOfReferenceUID", "none")
        raise fault(path, "FrameOfReferenceUID", f"the volume's {frame_of_reference}, as both are of one study", found)
