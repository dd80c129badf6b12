"""Images and volumes of OpenIGTLink, with their place in space.

The message gives the position of the image's middle: of the point half way between the centres of its first and last pixels.
Here the matrix takes indices of pixels (i, j, k), whose centres are whole numbers, to RAS in mm. A B-scan's i is
the column u, j the row v.
"""

import math
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.devices.openigtlink import igtl_header
from recon.errors import InputError

Array = NDArray[np.float64]

HEAD = struct.Struct(">H4B3H12f3H3H")  # version, channels, type, byte order, space, size, place, first and size of the part
TYPES = {2: "i1", 3: "u1", 4: "i2", 5: "u2", 6: "i4", 7: "u4", 10: "f4", 11: "f8"}  # of a level
BIG, LITTLE = 1, 2
RAS, LPS = 1, 2
RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
UNPLACED = np.eye(4)  # millimetres a pixel, from the first one's centre


@dataclass(frozen=True)
class Image:
    """An image or a volume in space."""

    levels: NDArray  # (h, w), (depth, h, w) or (depth, h, w, channels)
    ras_from_index: Array  # (4, 4), from (i, j, k, 1) to mm

    @property
    def plane(self) -> NDArray:
        """The first plane : (h, w) or (h, w, channels)."""
        return self.levels if self.levels.ndim == 2 else self.levels[0]


def write(image: Image) -> bytes:
    """An image's bytes, in space RAS and in the byte order of most machines.

    Raises
    ------
    InputError
        If its shape, its kind of levels or its place is none that the message has.
    """
    levels = image.levels if image.levels.ndim != 2 else image.levels[None]
    depth, height, width, channels = (*levels.shape, 1)[:4] if levels.ndim in (3, 4) else (0, 0, 0, 0)
    code = next((code for code, name in TYPES.items() if levels.dtype.newbyteorder("=") == np.dtype(name)), None)
    longest = 0xFFFF  # side, px
    if code is None or not 1 <= channels <= 255 or not 0 < min(depth, height, width) <= max(depth, height, width) <= longest:
        raise InputError(f"expected an image or a volume of numbers, found {image.levels.shape} {levels.dtype}")
    if np.shape(image.ras_from_index) != (4, 4):
        raise InputError(f"expected a matrix of 4 x 4 as the image's place, found {np.shape(image.ras_from_index)}")
    size = (width, height, depth)
    place = (_thick(image.ras_from_index) @ np.column_stack([np.eye(4)[:, :3], _middle(size)]))[:3].T
    head = HEAD.pack(1, channels, code, LITTLE, RAS, *size, *igtl_header.finite(place).ravel().tolist(), 0, 0, 0, *size)
    return head + levels.astype(levels.dtype.newbyteorder("<"), copy=False).tobytes()


def read(content: memoryview) -> Image:
    """Read an image; one of a single plane and channel comes as (h, w). The levels stay in the message's memory, read-only.

    Raises
    ------
    InputError
        If the sizes contradict the number of bytes, or only a part of the image is there.
    """
    if len(content) < HEAD.size:
        raise InputError(f"expected at least {HEAD.size} bytes, found {len(content)}")
    _, channels, code, order, space, *numbers = HEAD.unpack_from(content)
    size, place, first, part = numbers[:3], igtl_header.finite(np.array(numbers[3:15])), numbers[15:18], numbers[18:]
    if code not in TYPES or order not in (BIG, LITTLE) or space not in (RAS, LPS):
        known = ", ".join(map(str, TYPES))
        raise InputError(f"expected type {known}, byte order 1 or 2 and space 1 or 2, found {code}, {order} and {space}")
    if part != size or any(first):
        raise InputError(f"expected a whole image of {_by(size)} pixels, found a part of {_by(part)}")
    pixel = np.dtype(TYPES[code]).newbyteorder(">" if order == BIG else "<")
    if 0 in (*size, channels) or len(content) - HEAD.size != math.prod(size) * channels * pixel.itemsize:
        raise InputError(f"expected the bytes of {_by(size)} pixels of {channels} {pixel.name}, found {len(content) - HEAD.size}")
    levels = np.frombuffer(content, pixel, offset=HEAD.size).reshape(*size[::-1], channels)
    grey = levels[..., 0] if channels == 1 else levels
    return Image(grey[0] if grey.shape[0] == 1 and channels == 1 else grey, _ras_from_index(place, size, space))


def _thick(matrix: Array) -> Array:
    """A place whose planes are 1 mm apart if it has them at no distance, by which Slicer would divide."""
    if matrix[:3, 2].any():
        return matrix
    normal = np.cross(matrix[:3, 0], matrix[:3, 1])
    thick = matrix.copy()
    thick[:3, 2] = normal / max(float(np.linalg.norm(normal)), 1e-30)
    return thick


def _ras_from_index(place: Array, size: list[int], space: int) -> Array:
    """The matrix from three columns and the middle."""
    matrix = np.eye(4)
    matrix[:3] = place.reshape(4, 3).T
    matrix[:3, 3] -= matrix[:3, :3] @ _middle(size)[:3]
    return RAS_FROM_LPS @ matrix if space == LPS else matrix


def _middle(size: list[int] | tuple[int, int, int]) -> Array:
    """Index of the point half way between the first and last pixels' centres : (4,)."""
    return np.array([*((length - 1) / 2 for length in size), 1.0])


def _by(size: list[int]) -> str:
    return "x".join(map(str, size))
