"""Peers of OpenIGTLink other than ours: bytes by the specification, a server of such bytes, and messages of all kinds."""

import socket
import struct
import threading
from contextlib import contextmanager

import numpy as np

from recon.devices.openigtlink.igtl_image import Image
from recon.devices.openigtlink.igtl_messages import Message, Points, Raw, Status, Text, Tools, Transform
from recon.devices.openigtlink.igtl_model import Model

TIME_NS = 1_790_000_000_123_456_789


def slow_crc64(data: bytes) -> int:
    """The checksum bit by bit, as a division."""
    rest = 0
    for byte in data:
        rest ^= byte << 56
        for _ in range(8):
            rest = (rest << 1) ^ (0x142F0E1EBA9EA3693 if rest >> 63 else 0)
    return rest


def plus_frame(kind: bytes, device: bytes, content: bytes, entries: list[tuple[bytes, bytes]], number: int = 7) -> bytes:
    """A message as PLUS writes it, protocol 3: header of version 2, extended header, content, metadata."""
    index = struct.pack(">H", len(entries)) + b"".join(struct.pack(">HHI", len(k), 3, len(v)) for k, v in entries)
    values = b"".join(k + v for k, v in entries)
    body = struct.pack(">HHII", 12, len(index), len(values), number) + content + index + values
    time = (TIME_NS // 10**9 << 32) + round((TIME_NS % 10**9) * 2**32 / 10**9)
    head = struct.pack(">H", 2) + kind.ljust(12, b"\0") + device.ljust(20, b"\0")
    return head + struct.pack(">QQQ", time, len(body), slow_crc64(body)) + body


def plus_image(levels: np.ndarray, device: bytes = b"Image_Reference") -> bytes:
    """A B-scan of PLUS: 0.1 x 0.2 mm pixels, x right, y down in an LPS-like frame, declared RAS; its middle at (40, 30, 20)."""
    height, width = levels.shape
    head = struct.pack(">HBBBB3H", 2, 1, 3, 2, 1, width, height, 1)
    place = struct.pack(">12f", 0.1, 0, 0, 0, 0.2, 0, 0, 0, 1, 40, 30, 20)
    part = struct.pack(">6H", 0, 0, 0, width, height, 1)
    return plus_frame(
        b"IMAGE", device, head + place + part + levels.tobytes(), [(b"FrameNumber", b"12"), (b"ProbeStatus", b"OK")]
    )


@contextmanager
def served(*pieces: bytes):
    """A server on loopback that sends pieces to whoever connects, and then waits; gives its port and the connections."""
    listener = socket.create_server(("127.0.0.1", 0))
    connections: list[socket.socket] = []

    def serve() -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            connections.append(connection)
            for piece in pieces:
                try:
                    connection.sendall(piece)
                except OSError:
                    break

    threading.Thread(target=serve, daemon=True).start()
    try:
        yield listener.getsockname()[1], connections
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        for connection in connections:
            connection.close()


def pose(rng: np.random.Generator) -> np.ndarray:
    """Any affine transform of numbers that float32 has."""
    matrix = np.eye(4)
    matrix[:3] = np.float32(rng.normal(0, 100, (3, 4)))
    return matrix


def all_kinds(rng: np.random.Generator) -> list[Message]:
    """A message of each kind that is written."""
    poses = np.array([pose(rng), pose(rng)])
    triangles = rng.integers(0, 5, (7, 3))
    points, diameters = np.float32(rng.normal(0, 50, (5, 3))).astype(float), np.array([1.0, 2.5])
    colours = np.array([[1, 2, 3, 4], [5, 6, 7, 255]], np.uint8)
    contents = {
        "ProbeToTracker": Transform(pose(rng)),
        "Image": Image(rng.integers(0, 256, (5, 8), np.uint8), pose(rng)),
        "Volume": Image(rng.integers(0, 4096, (3, 4, 5), np.uint16), pose(rng)),
        "Colours": Image(rng.integers(0, 256, (2, 4, 5, 3), np.uint8), pose(rng)),
        "Heights": Image(rng.normal(size=(2, 3)), pose(rng)),
        "Skin": Model(points, triangles),
        "State": Status(13, "warming up", "Warm", -5),
        "Text": Text("2 masses, Brüste"),
        "Tools": Tools(("probe", "needle"), poses, (2, 3)),
        "Masses": Points(("m1", "m2"), points[:2], ("masses", "masses"), colours, diameters),
        "Query": Raw("GET_STATUS"),
    }
    return [Message(name, content, TIME_NS, {"Sigma": "0.1 mm", "Grüße": "ü"}, 9) for name, content in contents.items()]


def same(found: object, expected: object) -> bool:
    """Whether two contents hold the same numbers; images' places within float32's rounding of their middles."""
    if type(found) is not type(expected):
        return False
    if isinstance(found, Image):
        near = np.allclose(found.ras_from_index, expected.ras_from_index, rtol=1e-6, atol=3e-4)
        return near and found.levels.dtype == expected.levels.dtype and np.array_equal(found.levels, expected.levels)
    return all(np.array_equal(value, vars(expected)[name]) for name, value in vars(found).items())
