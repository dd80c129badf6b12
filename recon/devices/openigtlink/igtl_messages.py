"""Messages of OpenIGTLink: transforms, images, models, tools, points, status and text, as arrays, and as bytes.

Space is RAS in mm everywhere, as 3D Slicer's is: images that are declared LPS are turned when they are read. A transform goes by
its name: `ProbeToTracker` takes points of the probe to the tracker's frame, `tracker_from_probe`.

Source: the protocol's specification, version 3.0 of 2017, and what PLUS and 3D Slicer write.
"""

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from recon.devices.openigtlink import igtl_header, igtl_image, igtl_model
from recon.devices.openigtlink.igtl_header import Body, Header
from recon.devices.openigtlink.igtl_image import Image
from recon.devices.openigtlink.igtl_model import Model
from recon.errors import InputError, reason, short

Array = NDArray[np.float64]

OK = 1  # of a status; others are 2 unknown error, 4 not found, 6 busy, 7 connection lost, 13 not ready, 18 hardware failure
STATE = struct.Struct(">Hq20s")
ROWS = 12  # numbers of a transform: its columns, less the last row
TOOL = struct.Struct(f">20sBx{4 * ROWS}s")
TURNED_TOOL = struct.Struct(">20sBx28s")  # with a quaternion
POINT = struct.Struct(">64s32s4B3ff20s")
PLACES = {12: 3, 24: 6, 28: 7}  # numbers of a POSITION, by its bytes: place, and three or all of a quaternion's


@dataclass(frozen=True)
class Transform:
    """A transform, named by its device: of `ProbeToTracker` this is `tracker_from_probe`."""

    matrix: Array  # (4, 4), mm


@dataclass(frozen=True)
class Status:
    """A device's state."""

    code: int = OK
    text: str = ""
    name: str = ""  # of an error, 20 letters
    detail: int = 0  # a code of the device's own


@dataclass(frozen=True)
class Text:
    """A STRING: up to 65535 bytes."""

    text: str


@dataclass(frozen=True)
class Tools:
    """Poses of tracked tools, as NDI's and others' trackers send them: TDATA, or QTDATA."""

    names: tuple[str, ...]
    tracker_from_tool: Array  # (n, 4, 4), mm
    types: tuple[int, ...]  # 1 tracker, 2 in six dimensions, 3 in three, 4 in five


@dataclass(frozen=True)
class Points:
    """Points with names, such as fiducials."""

    names: tuple[str, ...]  # at most 64 bytes each
    points: Array  # (n, 3), mm
    groups: tuple[str, ...] = ()  # n, or none
    colours: NDArray[np.uint8] | None = None  # (n, 4), red, green, blue, opacity
    diameters: Array | None = None  # (n,), mm


@dataclass(frozen=True)
class Raw:
    """What has no content that we read: queries such as GET_STATUS, answers that have nothing to give, other kinds."""

    kind: str
    content: bytes = b""


Content = Transform | Image | Model | Status | Text | Tools | Points | Raw


@dataclass(frozen=True)
class Message:
    """A content with its name and time."""

    device: str
    content: Content
    time_ns: int | None = None  # since 1970, UTC
    metadata: Mapping[str, str] = field(default_factory=dict)  # that headers of version 2 have room for
    number: int = 0  # likewise

    @property
    def kind(self) -> str:
        """The kind in the header."""
        return self.content.kind if isinstance(self.content, Raw) else KINDS[type(self.content)]

    @property
    def name(self) -> str:
        """The message's name in lines for people."""
        return f"{self.kind} of {short(self.device)!r}"


def pack(message: Message, version: int = 2) -> bytes:
    """Write a message with a header of version 1, which any receiver reads, or 2, which has metadata.

    Raises
    ------
    InputError
        If a name is too long, a shape is wrong, a number is not finite or the time is outside 1970 to 2106.
    """
    try:
        content = _write(message.content)
    except (struct.error, OverflowError) as error:
        raise InputError(f"{message.name}: expected numbers that its fields have room for: {reason(error)}") from None
    except InputError as error:
        raise InputError(f"{message.name}: {error}") from None
    return igtl_header.join(
        version, message.kind, message.device, message.time_ns, Body(memoryview(content), message.number, message.metadata)
    )


def unpack(header: Header, body: bytes) -> Message:
    """Read a body. Kinds that aren't known come as `Raw`, as do those that are empty, which answer that there is nothing.

    Raises
    ------
    InputError
        If the body isn't one of its kind; the message names kind and device.
    """
    parts = igtl_header.split(header, body)
    read = READERS.get(header.kind) if parts.content else None
    try:
        content = read(parts.content) if read else Raw(header.kind, bytes(parts.content))
    except InputError as error:
        raise InputError(f"{header.name}: {error}") from None
    return Message(header.device, content, header.time_ns, parts.metadata, parts.number)


def _write(content: Content) -> bytes:
    match content:
        case Transform():
            return _columns(content.matrix)
        case Image():
            return igtl_image.write(content)
        case Model():
            return igtl_model.write(content)
        case Status():
            return STATE.pack(content.code, content.detail, content.name.encode()[:20]) + content.text.encode() + b"\0"
        case Text():
            return _text_bytes(content.text)
        case Tools():
            poses = zip(content.names, content.types, content.tracker_from_tool, strict=True)
            return b"".join(TOOL.pack(_name(name, 20), kind, _columns(pose)) for name, kind, pose in poses)
        case Points():
            return b"".join(_point_bytes(content))
        case Raw():
            return content.content


def _columns(matrix: Array) -> bytes:
    """A transform's upper rows, column by column; the last row is 0 0 0 1."""
    if np.shape(matrix) != (4, 4) or not np.allclose(matrix[3], (0, 0, 0, 1), rtol=0, atol=1e-9):
        raise InputError(f"expected a matrix of 4 x 4 whose last row is 0 0 0 1, found {short(repr(matrix))}")
    return igtl_header.finite(np.asarray(matrix)[:3].T).astype(">f4").tobytes()


def _text_bytes(text: str) -> bytes:
    code, letters = igtl_header.encoded(text)
    if len(letters) > 0xFFFF:
        raise InputError(f"expected a text of at most 65535 bytes, found one of {len(letters)}")
    return struct.pack(">HH", code, len(letters)) + letters


def _point_bytes(content: Points) -> Iterator[bytes]:
    n = len(content.names)
    groups = content.groups or ("",) * n
    colours = np.full((n, 4), 255, np.uint8) if content.colours is None else content.colours
    diameters = np.zeros(n) if content.diameters is None else content.diameters
    for name, group, colour, point, diameter in zip(content.names, groups, colours, content.points, diameters, strict=True):
        yield POINT.pack(_name(name, 64), _name(group, 32), *colour.tolist(), *point.tolist(), float(diameter), b"")


def _name(name: str, most: int) -> bytes:
    if len(letters := name.encode()) > most:
        raise InputError(f"expected a name of at most {most} bytes, found {short(name)!r}")
    return letters


def _read_transform(content: memoryview) -> Transform:
    return Transform(_matrix(_whole(content, 4 * ROWS)))


def _read_position(content: memoryview) -> Transform:
    if len(content) not in PLACES:
        raise InputError(f"expected {', '.join(map(str, PLACES))} bytes, found {len(content)}")
    return Transform(_place(content))


def _read_status(content: memoryview) -> Status:
    if len(content) < STATE.size:
        raise InputError(f"expected at least {STATE.size} bytes, found {len(content)}")
    code, detail, name = STATE.unpack_from(content)
    utf8 = igtl_header.UTF8
    return Status(code, igtl_header.text(content[STATE.size :], utf8), igtl_header.text(name, utf8), detail)


def _read_text(content: memoryview) -> Text:
    if len(content) < 4:
        raise InputError(f"expected at least 4 bytes, found {len(content)}")
    code, length = struct.unpack_from(">HH", content)
    return Text(igtl_header.text(_whole(content[4:], length), code))


def _read_tools(content: memoryview) -> Tools:
    return _tools([(*TOOL.unpack(record)[:2], _matrix(record[-4 * ROWS :])) for record in _records(content, TOOL.size)])


def _read_turned_tools(content: memoryview) -> Tools:
    return _tools([(*TURNED_TOOL.unpack(record)[:2], _place(record[-28:])) for record in _records(content, TURNED_TOOL.size)])


def _tools(found: list[tuple[bytes, int, Array]]) -> Tools:
    names = tuple(igtl_header.text(name, igtl_header.UTF8) for name, _, _ in found)
    return Tools(names, np.array([pose for _, _, pose in found]), tuple(kind for _, kind, _ in found))


def _read_points(content: memoryview) -> Points:
    found = [POINT.unpack(record) for record in _records(content, POINT.size)]
    names, groups = (tuple(igtl_header.text(one[k], igtl_header.UTF8) for one in found) for k in (0, 1))
    places = igtl_header.finite(np.array([one[6:10] for one in found]))
    return Points(names, places[:, :3], groups, np.array([one[2:6] for one in found], np.uint8), places[:, 3])


def _whole(content: memoryview, size: int) -> memoryview:
    if len(content) != size:
        raise InputError(f"expected {size} bytes, found {len(content)}")
    return content


def _records(content: memoryview, size: int) -> list[memoryview]:
    most_records = 10_000  # tools or points, each of which takes some kB to read
    if len(content) % size or len(content) > most_records * size:
        raise InputError(f"expected at most {most_records} records of {size} bytes, found {len(content)} bytes")
    return [content[at : at + size] for at in range(0, len(content), size)]


def _matrix(content: memoryview) -> Array:
    """The inverse of `_columns`."""
    numbers = igtl_header.finite(np.frombuffer(content, ">f4"))
    matrix = np.eye(4)
    matrix[:3] = numbers.reshape(4, 3).T
    return matrix


def _place(content: memoryview) -> Array:
    """A place and, after it, a quaternion x, y, z, w or its first three numbers : (4, 4)."""
    numbers = igtl_header.finite(np.frombuffer(content, ">f4"))
    axis = numbers[3:6] if len(numbers) > 3 else np.zeros(3)
    real = numbers[6] if len(numbers) > 6 else np.sqrt(max(1 - axis @ axis, 0.0))
    length = float(np.hypot(np.sqrt(axis @ axis), real))
    if not 0.99 < length < 1.01:
        raise InputError(f"expected a quaternion of length 1, found {length:.4g}")
    (x, y, z), w = axis / length, real / length
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] += 2 * (w * skew + skew @ skew)
    matrix[:3, 3] = numbers[:3]
    return matrix


READERS = {
    "TRANSFORM": _read_transform,
    "POSITION": _read_position,
    "IMAGE": igtl_image.read,
    "POLYDATA": igtl_model.read,
    "STATUS": _read_status,
    "STRING": _read_text,
    "TDATA": _read_tools,
    "QTDATA": _read_turned_tools,
    "POINT": _read_points,
}
KINDS = {
    Transform: "TRANSFORM",
    Image: "IMAGE",
    Model: "POLYDATA",
    Status: "STATUS",
    Text: "STRING",
    Tools: "TDATA",
    Points: "POINT",
}
