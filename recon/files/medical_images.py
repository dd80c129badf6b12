"""Headers of MetaImage (.mha, .mhd) and NRRD (.nrrd, .nhdr) files with fields of one's own, and their pixels a block at a time.

Both are text, name and value a line, followed by the pixels or by the name of the file that has them. PLUS's .mkv files are
taken as if they had such a header. What the fields mean is for `recon.freehand.sequences` and `recon.files.volumes`; here they
are found, and the pixels are unpacked without ever being in memory at once.
"""

import math
import os
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError, brief, short
from recon.files import matroska, video_file
from recon.files.matroska import Element, Frame
from recon.files.regular import check_there, opened

META_TYPES = {
    "MET_UCHAR": "u1",
    "MET_CHAR": "i1",
    "MET_USHORT": "u2",
    "MET_SHORT": "i2",
    "MET_UINT": "u4",
    "MET_INT": "i4",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
NRRD_TYPES = {  # those of sequences, each with many names
    **dict.fromkeys(("unsigned char", "uchar", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(("unsigned short", "unsigned short int", "ushort", "uint16", "uint16_t"), "u2"),
    **dict.fromkeys(("short", "short int", "signed short", "signed short int", "int16", "int16_t"), "i2"),
    "float": "f4",
    "double": "f8",
}
NO_PIXELS = ("MET_OTHER", "MET_NONE", "")  # types, in either format, of PLUS's files without images


@dataclass(frozen=True)
class ImageFile:
    """An image file whose header was read: its fields, and the place of its pixels."""

    path: Path  # of the header
    fields: dict[str, str]  # as they stand in the header, in its order
    size: tuple[int, ...]  # px along each axis, the fastest first
    pixel: np.dtype  # of no bytes where there are no pixels
    packed: bool  # by zlib or gzip
    data_path: Path
    data_offset: int  # bytes before the pixels
    channels: int = 1  # numbers a pixel, where they have no axis of their own
    frames: tuple[Frame, ...] = ()  # of a Matroska file
    coded: bool = False  # as a video, of which OpenCV makes the images

    @property
    def data_bytes(self) -> int:
        """Unpacked size of all pixels."""
        return math.prod(self.size) * self.channels * self.pixel.itemsize

    def fault(self, field: str, expected: object, found: object) -> InputError:
        """The error of a field of this file."""
        return fault(self.path, field, expected, found)


def fault(path: Path, field: str, expected: object, found: object) -> InputError:
    """The error of a field of a file; long values are shortened."""
    return InputError(f"{path}: {short(field)}: expected {expected}, found {short(str(found))}")


def read_header(path: Path) -> ImageFile:
    """Read the header of a MetaImage, NRRD or Matroska file, told apart by how it begins.

    Raises
    ------
    InputError
        If there is no such file, it is of another kind, or the header is incomplete, contradicts itself or asks for more pixels
        than the file can hold.
    """
    path = Path(path)
    with opened(path) as stream:
        start = stream.read(len(matroska.START))
        stream.seek(0)
        if start == matroska.START:
            return _matroska(path)
        file = _nrrd(path, stream) if start == b"NRRD" else _metaimage(path, stream)
    _check_length(file)
    return file


def blocks(file: ImageFile, length: int) -> Iterator[bytes]:
    """The pixels in blocks of `length` bytes, which divides their total; one block is in memory at a time.

    Raises
    ------
    InputError
        If there are fewer or more pixels than the header says, or packed ones are damaged.
    """
    waiting, got = bytearray(), 0
    for piece in _pieces(file):
        got += len(piece)
        if got > file.data_bytes:
            raise file.fault("pixels", f"{file.data_bytes} bytes", "more")
        waiting += piece
        while len(waiting) >= length:
            yield bytes(waiting[:length])
            del waiting[:length]
    if got < file.data_bytes:
        raise file.fault("pixels", f"{file.data_bytes} bytes", f"{got}, the file has been cut short or damaged")


def pack(images: NDArray, gzip: bool) -> bytes:
    """One zlib or gzip stream of images, packed one by one; fast rather than small, B-scans being mostly noise."""
    packer = zlib.compressobj(level=1, wbits=31 if gzip else 15)
    return b"".join([*(packer.compress(np.ascontiguousarray(image)) for image in images), packer.flush()])


def whole_numbers(path: Path, field: str, text: str, least: int = 0, pieces: int | None = None) -> tuple[int, ...]:
    """Whole numbers of a header's field, separated by any number of spaces; any number of them if `pieces` is not given."""
    try:
        numbers = tuple(int(word) for word in text.split())
    except ValueError:
        numbers = ()
    most_whole = 1 << 40  # of any number of a header
    if not numbers or min(numbers) < least or max(numbers) > most_whole or len(numbers) != (pieces or len(numbers)):
        expected = "a whole number" if pieces == 1 else f"{pieces or ''} whole numbers".lstrip()
        raise fault(path, field, f"{expected} of at least {least}", repr(text))
    return numbers


def numbers(path: Path, field: str, text: str, count: int) -> np.ndarray:
    """Finite decimal numbers of a header's field, as float64."""
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.array([np.nan])
    if len(values) != count or not np.isfinite(values).all():
        raise fault(path, field, "a finite number" if count == 1 else f"{count} finite numbers", repr(text))
    return values


def _metaimage(path: Path, stream: BinaryIO) -> ImageFile:
    fields: dict[str, str] = {}
    while "ElementDataFile" not in fields:
        line = _line(path, stream)
        if not line:
            raise fault(path, "ElementDataFile", "a value at the header's end", "the end of the file")
        name, sign, value = line.partition("=")
        if not sign:
            raise InputError(f"{path}: expected lines of a MetaImage header, 'name = value', found {_shown(line)}")
        fields[name.strip()] = value.strip()
    size = whole_numbers(path, "DimSize", _value(path, fields, "DimSize"))
    dimensions = whole_numbers(path, "NDims", fields.get("NDims", str(len(size))))
    if dimensions != (len(size),):
        raise fault(path, "DimSize", f"{dimensions[0]} numbers as in NDims", repr(fields["DimSize"]))
    if fields.get("BinaryData", "True").lower() != "true":
        raise fault(path, "BinaryData", "True", fields["BinaryData"])
    (channels,) = whole_numbers(path, "ElementNumberOfChannels", fields.get("ElementNumberOfChannels", "1"), 1, 1)
    kind = _value(path, fields, "ElementType")
    if kind not in META_TYPES and kind not in NO_PIXELS:
        raise fault(path, "ElementType", f"one of {', '.join(META_TYPES)}", kind)
    big = fields.get("BinaryDataByteOrderMSB", fields.get("ElementByteOrderMSB", "False")).lower() == "true"
    local = fields["ElementDataFile"].upper() == "LOCAL"
    return ImageFile(
        path,
        fields,
        size,
        np.dtype((">" if big else "<") + META_TYPES.get(kind, "V0")),
        fields.get("CompressedData", "False").lower() == "true",
        path if local else path.parent / fields["ElementDataFile"],
        stream.tell() if local else 0,
        channels,
    )


def _nrrd(path: Path, stream: BinaryIO) -> ImageFile:
    """The header of an NRRD file of levels as sequences have them; files of others are read by pynrrd."""
    fields: dict[str, str] = {}
    _line(path, stream)
    while (line := _line(path, stream)).strip():
        if line.startswith("#"):
            continue
        name, sign, value = line.partition(":")
        if not sign:
            raise InputError(f"{path}: expected lines of an NRRD header, 'name: value', found {_shown(line)}")
        fields[name.strip()] = value.removeprefix("=").strip()  # PLUS writes some fields of its own with ":", some with ":="
    detached = fields.get("data file", fields.get("datafile"))
    if not line and not detached:
        raise fault(path, "header", "an empty line at its end", "the end of the file")
    size = whole_numbers(path, "sizes", _value(path, fields, "sizes"))
    if whole_numbers(path, "dimension", _value(path, fields, "dimension")) != (len(size),):
        raise fault(path, "sizes", f"{fields['dimension']} numbers as in dimension", repr(fields["sizes"]))
    kind = _value(path, fields, "type")
    if kind not in NRRD_TYPES and kind not in NO_PIXELS:
        raise fault(path, "type", "unsigned char, unsigned short, short, float or double", kind)
    pixel = np.dtype((">" if fields.get("endian", "little") == "big" else "<") + NRRD_TYPES.get(kind, "V0"))
    encoding = _value(path, fields, "encoding")
    if encoding not in ("raw", "gz", "gzip"):
        raise fault(path, "encoding", "raw or gzip", encoding)
    data = path.parent / detached if detached else path
    return ImageFile(path, fields, size, pixel, encoding != "raw", data, 0 if detached else stream.tell())


def _line(path: Path, stream: BinaryIO) -> str:
    longest_line = 1 << 20  # bytes; a file of another kind may have no line breaks at all
    line = stream.readline(longest_line)
    most_header = 1 << 28  # bytes; a sequence of five hours has half as many
    if stream.tell() > most_header:
        raise InputError(f"{path}: expected a header of up to {most_header >> 20} MiB, found a longer one")
    if len(line) == longest_line:
        raise InputError(f"{path}: expected a MetaImage or NRRD header, found a line of {longest_line} bytes")
    return line.decode("utf-8", "surrogateescape")


def _shown(line: str) -> str:
    """A line for a message."""
    return brief(line.strip()) if line.strip().isprintable() else "no text"


def _value(path: Path, fields: Mapping[str, str], name: str) -> str:
    if name not in fields:
        raise fault(path, name, "a value", "none")
    return fields[name]


def _check_length(file: ImageFile) -> None:
    """Refuse at once, before memory is asked for, what can't be complete."""
    if file.data_path != file.path:
        check_beside(file.path, file.data_path)
    there = file.data_path.stat().st_size - file.data_offset
    if file.packed:
        said = file.fields.get("CompressedDataSize", "").split()
        if said and said[0].isdecimal() and there < int(said[0]):
            raise file.fault("pixels", f"{said[0]} packed bytes", f"{there}, the file has been cut short")
    most_unpacked = 1100  # times the packed size: deflate reaches 1032
    if file.data_bytes > there * (most_unpacked if file.packed else 1):
        raise file.fault("pixels", f"{file.data_bytes} bytes", f"{there}, the file has been cut short or damaged")


def check_beside(header: Path, data: Path) -> None:
    """Refuse a file of pixels that lies elsewhere than its header, or below it: a header from others may name any file."""
    try:
        check_there([data])
    except InputError:
        raise fault(header, "data file", "LOCAL or the name of a file that is there", repr(data.name)) from None
    beside = os.path.relpath(os.path.abspath(data), os.path.abspath(header.parent))
    if beside.split(os.sep)[0] == os.pardir or os.path.isabs(beside):
        raise fault(header, "data file", "LOCAL or the name of a file in the header's folder", repr(str(data)))


def _matroska(path: Path) -> ImageFile:
    """A sequence as PLUS writes it with the suffix .mkv: texts belong to the frame of the same time."""
    file = matroska.read(path)
    videos = [number for number in file.of_kind(matroska.VIDEO) if file.frames.get(number)]
    if len(videos) != 1:
        raise fault(path, "tracks", "one of images", len(videos))
    track, frames = file.tracks[videos[0]], tuple(file.frames[videos[0]])
    width, height = track.number(Element.WIDTH), track.number(Element.HEIGHT)
    uncompressed, grey = "V_UNCOMPRESSED", "Y800"  # of images in a Matroska file
    coded = track.text(Element.CODEC) != uncompressed
    if coded:
        frames = tuple(sorted(frames))  # as they are shown, which may not be the order in which they are decoded
    channels = 1 if track.text(Element.COLOUR) == grey and not coded else 3
    wrong = [frame.length for frame in frames if frame.length != width * height * channels]
    most_px = 1 << 26  # of a video's images
    if not 0 < width * height <= most_px or (wrong and not coded):
        raise fault(path, "frames", f"{width} x {height} pixels of {channels} bytes", f"{(wrong or [0])[0]} bytes")
    fields = {"Kinds": "domain domain list", "TrackName": track.text(Element.NAME)}
    of_time: dict[int, list[int]] = {}
    for number, frame in enumerate(frames):
        of_time.setdefault(frame.time_ns, []).append(number)
        fields[f"Seq_Frame{number:04d}_Timestamp"] = repr(frame.time_ns * 1e-9)
    with opened(path) as stream:
        for text in file.of_kind(*matroska.TEXTS):
            name, used = file.tracks[text].text(Element.NAME), dict[int, int]()
            for frame in file.frames.get(text, []):
                k = used[frame.time_ns] = used.get(frame.time_ns, -1) + 1  # frames of one time take texts in their order
                numbers = of_time.get(frame.time_ns, [])
                if k < len(numbers) and frame.length <= matroska.MOST_TEXT:
                    stream.seek(frame.offset)
                    value = stream.read(frame.length).split(b"\0")[0].decode("utf-8", "surrogateescape")
                    fields[f"Seq_Frame{numbers[k]:04d}_{name}"] = value.strip()
    return ImageFile(path, fields, (width, height, len(frames)), np.dtype("u1"), False, path, 0, channels, frames, coded)


def _decode(file: ImageFile) -> Iterator[bytes]:
    """Images of a Matroska file : (h, w, 3), red first, one by one."""
    video, shape = video_file.opened(file.path), (file.size[1], file.size[0], 3)
    try:
        for number in range(len(file.frames)):
            found, image = video.read()
            if not found or image.shape != shape:
                raise file.fault("frames", f"{len(file.frames)} images of {shape[1]} x {shape[0]} that OpenCV can decode", number)
            yield image[..., ::-1].tobytes()
    finally:
        video.release()


def _pieces(file: ImageFile) -> Iterator[bytes]:
    if file.coded:
        yield from _decode(file)
        return
    if file.frames:
        with opened(file.path) as stream:
            for frame in file.frames:
                stream.seek(frame.offset)
                yield stream.read(frame.length)
        return
    unpacker = zlib.decompressobj(wbits=47) if file.packed else None  # 47: a zlib or a gzip stream
    read_at_once = 1 << 18  # bytes
    with opened(file.data_path) as stream:
        stream.seek(file.data_offset)
        while raw := stream.read(read_at_once):
            if unpacker is None:
                yield raw
                continue
            while raw and not unpacker.eof:
                try:
                    yield unpacker.decompress(raw, read_at_once)
                except zlib.error:
                    raise file.fault("pixels", "packed data", "damaged ones") from None
                raw = unpacker.unconsumed_tail
