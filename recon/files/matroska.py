"""Matroska files (.mkv) as PLUS writes its sequences: a track of images, and one of text for each field of the frames.

Elements are read one after the other; of those that hold others only their beginning counts, so that files of which a writer left
the sizes open are read as well.

Source: RFC 8794 (EBML) and RFC 9559 (Matroska).
"""

from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import BinaryIO, NamedTuple

from recon.errors import InputError
from recon.files.regular import opened

START = b"\x1a\x45\xdf\xa3"
VIDEO, TEXTS = 1, (0x11, 0x21)  # kinds of tracks
MOST_TEXT = 1 << 20  # bytes of a field


class Element(IntEnum):
    """Elements of a file that are read, by their numbers."""

    SEGMENT = 0x18538067
    INFO = 0x1549A966
    SCALE = 0x2AD7B1
    TRACKS = 0x1654AE6B
    TRACK = 0xAE
    NUMBER = 0xD7
    KIND = 0x83
    CODEC = 0x86
    NAME = 0x536E
    PICTURE = 0xE0  # what a track's images are
    COLOUR = 0x2EB524
    WIDTH = 0xB0
    HEIGHT = 0xBA
    ENCODINGS = 0x6D80
    CLUSTER = 0x1F43B675
    TIME = 0xE7
    GROUP = 0xA0
    SIMPLE = 0xA3
    BLOCK = 0xA1


HOLDERS = {
    *(Element.SEGMENT, Element.INFO, Element.TRACKS, Element.TRACK, Element.PICTURE, Element.CLUSTER, Element.GROUP),
}
OF_TRACKS = {
    *(Element.NUMBER, Element.KIND, Element.CODEC, Element.NAME, Element.COLOUR, Element.WIDTH, Element.HEIGHT),
    Element.ENCODINGS,
}


@dataclass
class Track:
    """A track's values, by the numbers of their elements."""

    values: dict[int, bytes] = field(default_factory=dict)

    def number(self, element: int) -> int:
        """A whole number; 0 where there is none."""
        return int.from_bytes(self.values.get(element, b""), "big")

    def text(self, element: int) -> str:
        """A text; empty where there is none."""
        return self.values.get(element, b"").split(b"\0")[0].decode("utf-8", "surrogateescape")


class Frame(NamedTuple):
    """A frame of a track."""

    time_ns: int
    offset: int  # of its bytes in the file
    length: int


@dataclass(frozen=True)
class Matroska:
    """Tracks of a file, and the frames of each, by the track's number."""

    tracks: dict[int, Track]
    frames: dict[int, list[Frame]]

    def of_kind(self, *kinds: int) -> list[int]:
        """Numbers of the tracks of some kinds."""
        return [number for number, track in self.tracks.items() if track.number(Element.KIND) in kinds]


def read(path: Path) -> Matroska:
    """Find tracks and frames of a file, whose bytes aren't read.

    Raises
    ------
    InputError
        If the file is damaged or cut short, or its frames are packed or several in a block.
    """
    tracks, frames = list[Track](), dict[int, list[Frame]]()
    usual_scale = 1_000_000  # ns
    scale, time, count = usual_scale, 0, 0
    laced = 0x06  # flags of a block with several frames
    most_blocks = 10_000_000
    with opened(path) as stream:
        end = stream.seek(0, 2)
        at = 0
        while at < end:
            stream.seek(at)
            element, size = _number(path, stream, marked=True), _number(path, stream)
            begin, length = stream.tell(), size or 0
            if begin + length > end or (size is None and element not in HOLDERS):
                raise _damaged(path, at)
            if element == Element.TRACK:
                tracks.append(Track())
            if element in HOLDERS:
                at = begin
                continue
            at = begin + length
            if element in OF_TRACKS and tracks:
                tracks[-1].values[element] = stream.read(min(length, MOST_TEXT))
            elif element == Element.SCALE:
                scale = int.from_bytes(stream.read(min(length, 8)), "big")
            elif element == Element.TIME:
                time = int.from_bytes(stream.read(min(length, 8)), "big")
            elif element in (Element.SIMPLE, Element.BLOCK):
                track = _number(path, stream)
                after, flags = int.from_bytes(stream.read(2), "big", signed=True), stream.read(1)
                if track is None or not flags or stream.tell() > at or (count := count + 1) > most_blocks:
                    raise _damaged(path, begin)
                if flags[0] & laced:
                    raise InputError(f"{path}: expected a frame in each block, found several in one at byte {begin}")
                frame = Frame((time + after) * scale, stream.tell(), at - stream.tell())
                frames.setdefault(track, []).append(frame)
    packed = [track for track in tracks if Element.ENCODINGS in track.values]
    if packed:
        raise InputError(
            f"{path}: expected tracks that aren't packed, found {packed[0].text(Element.NAME) or 'one'} packed or encrypted"
        )
    return Matroska({track.number(Element.NUMBER): track for track in tracks}, frames)


def _number(path: Path, stream: BinaryIO, marked: bool = False) -> int | None:
    """A number of one to eight bytes, with its mark of the length or without; None of a size that was left open."""
    at = stream.tell()
    first = stream.read(1)
    if not first or first == b"\0":
        raise _damaged(path, at)
    more = 8 - first[0].bit_length()
    rest = stream.read(more)
    if len(rest) < more:
        raise _damaged(path, at)
    number, ones = int.from_bytes(first + rest, "big"), (1 << 7 * (more + 1)) - 1
    if marked:
        return number
    return None if number & ones == ones else number & ones


def _damaged(path: Path, at: int) -> InputError:
    return InputError(f"{path}: expected a whole Matroska file, found it damaged or cut short at byte {at}")
