"""Multi-frame DICOM files of ultrasound scanners: frames, their times, and the region of the B-scan with its scale.

Tags and units are those of DICOM PS3.3, C.8.5.5 (US region calibration) and C.7.6.5 (cine).
"""

import io
import struct
import warnings
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import cv2
import numpy as np
import pydicom
from numpy.typing import NDArray
from pydicom.encaps import generate_frames
from pydicom.errors import BytesLengthException, InvalidDicomError
from pydicom.filereader import read_dataset
from pydicom.pixels import apply_color_lut, convert_color_space, get_decoder, iter_pixels, pixel_array
from pydicom.uid import UID, DeflatedExplicitVRLittleEndian, ExplicitVRLittleEndian, JPEGLossless, JPEGLosslessSV1

from recon.capture.image_formats import MOST_PX
from recon.clips import lossless_jpeg
from recon.clips.clip import Box, Clip, checked_seconds
from recon.clips.dialects import video_clip
from recon.errors import InputError, reason, short
from recon.files.regular import check_there, opened

Dataset = Any
Result = TypeVar("Result")

MOST_BYTES = 1 << 33
MOST_UNPACKED = 1 << 30  # bytes, of a file that is packed as a whole
PREAMBLE, PREFIX = 128, b"DICM"
META = 2  # group of the tags before the part that may be packed

LOSSLESS = (JPEGLossless, JPEGLosslessSV1)
DAMAGED = (  # what pydicom raises for files that are no DICOM, damaged, or compressed in ways that need other packages
    *(InvalidDicomError, BytesLengthException, AttributeError, EOFError, LookupError, OSError, OverflowError),
    *(RuntimeError, TypeError, ValueError, struct.error, zlib.error, MemoryError, NotImplementedError),
)


def recognises(path: Path) -> bool:
    """Whether it bears DICOM's mark, which some old ones lack, and isn't named as a video, in which OpenCV may find one."""
    if video_clip.recognises(path) or not path.is_file():
        return False
    with opened(path) as stream:
        return stream.read(PREAMBLE + len(PREFIX))[PREAMBLE:] == PREFIX


def read(path: Path) -> Clip:
    """Open a DICOM file of one frame or more, grey or in colour.

    Raises
    ------
    InputError
        If it is missing or damaged, or compressed in a way that can't be read here.
    """
    check_there([path])
    try:
        return _quietly(lambda: _clip(path))
    except InputError:
        raise
    except DAMAGED as error:
        raise InputError(f"{path}: expected a DICOM file, a video or a folder of images, found {reason(error)}") from None


def _clip(path: Path) -> Clip:
    header = _dataset(path, stop_before_pixels=True)
    _check_compression(path, header.file_meta.get("TransferSyntaxUID"))
    count = int(header.get("NumberOfFrames") or 1)
    most_frames = 1_000_000
    if not 1 <= count <= most_frames:
        raise ValueError(f"NumberOfFrames {count}")
    size = int(header.Columns), int(header.Rows)
    if not 0 < size[0] * size[1] <= MOST_PX:
        raise ValueError(f"images of {size[0]}x{size[1]}")
    seconds, region = times(header, count), _b_scan_region(header)
    image, scale = (None, None) if region is None else _within(*region, size)
    timed = None if seconds is None else checked_seconds(path, seconds)
    return Clip(path.name, size, count, timed, lambda: images(path, size, count), image, scale)


def images(path: Path, size: tuple[int, int], count: int) -> Iterator[NDArray[np.uint8]]:
    """Frames : (h, w), one by one; 16-bit ones scaled to 8 bits by their stored bits; InputError if one is damaged."""
    read = 0
    try:
        header = _quietly(lambda: _dataset(path))
        frames = _frames(header, count)
        while True:
            frame = _quietly(lambda: next(frames, None))
            if frame is None:
                break
            yield _quietly(partial(_grey, frame, header))
            read += 1
    except InputError:
        raise
    except DAMAGED as error:
        raise InputError(f"{path}: frame {read}: expected an image of {size[0]}x{size[1]}, found {reason(error)}") from None
    if read != count:
        raise InputError(f"{path}: expected {count} frames, as NumberOfFrames says, found {read}")


def _check_compression(path: Path, syntax: UID | None) -> None:
    """InputError if pixels are compressed in a way that can't be read here."""
    if syntax is None or not syntax.is_transfer_syntax or not syntax.is_encapsulated or syntax in LOSSLESS:
        return
    try:
        known = get_decoder(syntax).is_available
    except NotImplementedError:
        known = False
    if not known:
        expected = "expected pixels uncompressed, or as RLE, JPEG, lossless JPEG or JPEG 2000"
        raise InputError(f"{path}: TransferSyntaxUID: {expected}, found {short(syntax.name)}: gdcmconv --raw undoes it")


def _frames(header: Dataset, count: int) -> Iterator[NDArray]:
    """Frames of a file, of colours as RGB, unless its palette has them."""
    syntax = header.file_meta.TransferSyntaxUID
    if syntax in LOSSLESS:
        return _lossless(header, count)
    if syntax.is_encapsulated or header.get("PhotometricInterpretation") != "YBR_FULL_422":
        return iter_pixels(header)
    there = len(header.PixelData) // (2 * int(header.Rows) * int(header.Columns))  # of which iter_pixels errs
    if there != count:
        raise ValueError(f"pixels of {there} frames, NumberOfFrames {count}")
    return (pixel_array(header, index=index) for index in range(count))


def _lossless(header: Dataset, count: int) -> Iterator[NDArray]:
    """Frames of lossless JPEG; its samples are the stored ones, whatever colours they mean."""
    shape, levels = (int(header.Rows), int(header.Columns)), {8: np.uint8, 16: np.uint16}[int(header.BitsAllocated)]
    colours = str(header.PhotometricInterpretation)
    for packed in generate_frames(header.PixelData, number_of_frames=count):
        frame = lossless_jpeg.decode(packed).astype(levels)
        if frame.shape[:2] != shape or frame.ndim != (2 if int(header.SamplesPerPixel) == 1 else 3):
            raise ValueError(f"a JPEG image of {' x '.join(map(str, frame.shape))}")
        yield convert_color_space(frame, colours, "RGB") if colours.startswith("YBR") else frame


def _dataset(path: Path, stop_before_pixels: bool = False) -> Dataset:
    """Read a file; one that is packed as a whole, which may unpack to more than any memory, up to a bound."""
    with opened(path, MOST_BYTES) as stream:
        return pydicom.dcmread(_plain(path, stream), stop_before_pixels=stop_before_pixels)


def _plain(path: Path, stream: BinaryIO) -> BinaryIO:
    """A file from its beginning on, with what is packed as a whole unpacked; InputError if that is too large.

    Source: DICOM PS3.5, A.5: raw deflate behind the tags of group 2.
    """
    stream.seek(PREAMBLE)
    if stream.read(len(PREFIX)) == PREFIX:
        meta = read_dataset(stream, is_implicit_VR=False, is_little_endian=True, stop_when=lambda tag, *_: tag.group != META)
        if meta.get("TransferSyntaxUID") == DeflatedExplicitVRLittleEndian:
            length = stream.tell()
            content = zlib.decompressobj(-zlib.MAX_WBITS).decompress(stream.read(), MOST_UNPACKED + 1)
            if len(content) > MOST_UNPACKED:
                expected = f"expected up to {MOST_UNPACKED >> 20} MiB in a DICOM file that is deflated, found more"
                raise InputError(f"{path}: {expected}: save it uncompressed")
            stream.seek(0)
            packed, plain = (str(syntax).encode() for syntax in (DeflatedExplicitVRLittleEndian, ExplicitVRLittleEndian))
            return io.BytesIO(stream.read(length).replace(packed, plain.ljust(len(packed), b"\0")) + content)
    stream.seek(0)
    return stream


def _quietly(call: Callable[[], Result]) -> Result:
    """The result of a call, without pydicom's warnings of values that break a rule that nothing here depends on."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return call()


def _grey(frame: NDArray, header: Dataset) -> NDArray[np.uint8]:
    """Grey levels : (h, w) of a frame of any photometric interpretation; pydicom has made RGB of the other colours."""
    stored, kind = int(header.get("BitsStored", 8)), str(header.get("PhotometricInterpretation", "MONOCHROME2"))
    if kind == "PALETTE COLOR":
        frame = apply_color_lut(frame, header)
        stored = 8 * frame.dtype.itemsize
    plain = np.uint8(frame >> max(stored - 8, 0)) if frame.dtype != np.uint8 else frame
    if plain.ndim == 3:
        return cv2.cvtColor(np.ascontiguousarray(plain), cv2.COLOR_RGB2GRAY)
    return 255 - plain if kind == "MONOCHROME1" else plain  # of which 0 is white


def times(header: Dataset, count: int) -> NDArray[np.float64] | None:
    """Times of n frames : (n,) s from the first: by their vector, by the time of a frame, or by the rate; None without these."""
    vector = header.get("FrameTimeVector")
    if vector is not None and np.size(vector) == count:
        steps = np.ravel(np.array(vector, float))  # ms, each from the frame before
        return (np.cumsum(steps) - steps[0]) / 1e3
    step = float(header.get("FrameTime") or 0) / 1e3
    rate = float(header.get("CineRate") or header.get("RecommendedDisplayFrameRate") or 0)
    if step <= 0 and rate <= 0:
        return None
    return np.arange(count) * (step if step > 0 else 1 / rate)


def _b_scan_region(header: Dataset) -> tuple[Box, tuple[float, float] | None] | None:
    """The largest two-dimensional region of tissue, and its scale in mm/px; None where the file has none."""
    best: tuple[Box, tuple[float, float] | None] | None = None
    two_d, tissue, centimetres = 1, 1, 3  # RegionSpatialFormat, RegionDataType, PhysicalUnits
    for one in header.get("SequenceOfUltrasoundRegions") or []:
        if int(one.RegionSpatialFormat) != two_d or int(one.get("RegionDataType", tissue)) != tissue:
            continue
        left, top = int(one.RegionLocationMinX0), int(one.RegionLocationMinY0)
        box = left, top, int(one.RegionLocationMaxX1) - left + 1, int(one.RegionLocationMaxY1) - top + 1
        if min(box) < 0 or min(box[2:]) == 0:
            continue
        units = {int(one.get(f"PhysicalUnits{axis}Direction", 0)) for axis in "XY"}
        x, y = (10 * abs(float(one.get(f"PhysicalDelta{axis}", 0))) for axis in "XY")
        scale = (x, y) if units == {centimetres} and x > 0 and y > 0 else None
        if best is None or box[2] * box[3] > best[0][2] * best[0][3]:
            best = box, scale
    return best


def _within(region: Box, scale: tuple[float, float] | None, size: tuple[int, int]) -> tuple[Box, tuple[float, float] | None]:
    """A region less the pixel by which files that count from one overstep the image, and its scale.

    Farther beyond, the image is no longer the one that the region describes, and no scale of it is known.
    """
    u, v, width, height = region
    beyond = max(u + width - size[0], v + height - size[1])
    if beyond > 1:
        return region, None
    return (u, v, min(width, size[0] - u), min(height, size[1] - v)), scale
