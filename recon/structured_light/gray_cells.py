"""Projector coordinates from Gray code alone: the middle of the cell of the axis that a pixel's bits name."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel
from recon.model.patterns import GrayCode
from recon.structured_light.gray_code import Bits, cell_middle, read_bits
from recon.structured_light.phase import Noise
from recon.threads import in_threads

Image = NDArray[np.float32]

BLURRED = 2  # of the finest bits, that may be unreadable: the projector or the camera is out of focus for their stripes
WIDTH_SIGMA = 12**-0.5  # standard deviation of a coordinate that may lie anywhere in a cell of width 1
UNKNOWN = -1


class Levels(NamedTuple):
    """What a pixel shows without and with light. Both (h, w), DN."""

    black: Image
    white: Image


class Cells(NamedTuple):
    """Where pixels see the axis. All (h, w)."""

    middle: Image  # projector px, NaN where unknown
    sigma: Image  # projector px
    number: NDArray[np.int32]  # of the cell, as read; UNKNOWN where a bit isn't certain


class Axis(NamedTuple):
    """The cells of a code on the projector's axis."""

    first: float  # projector px, the middle of cell 0
    width: float  # projector px
    inverted: bool  # each bit's image is followed by its inverse


def levels(images: NDArray, code: GrayCode, uniform: NDArray) -> Levels:
    """Black and white of each pixel: with inverses from the code's images : (n, h, w), else from uniform ones : (m, h, w)."""
    shown = images if code.inverted else uniform
    return Levels(shown.min(axis=0).astype(np.float32), shown.max(axis=0).astype(np.float32))


def locate(images: NDArray, code: GrayCode, black_white: Levels, length: int, noise: Noise) -> Cells:
    """Projector coordinates of a code without fringes.

    A coordinate may lie anywhere in its cell, so its standard deviation is the width over the root of 12. Cells that the finest
    bits tell apart count as one wider cell where these bits are uncertain: their stripes may be too fine to be seen. Where a
    coarser bit is, the pixel sees the border of two cells, and lies within half a cell of it. Where more bits leave cells apart
    from each other, the coordinate is unknown.

    Parameters
    ----------
    images : (code.count, h, w), DN
        In the order of the code: each bit, followed by its inverse where the code has inverses.
    black_white : Levels
        A bit without an inverse is white above the middle of both.
    length : int, projector px
        Of the axis.
    noise : Noise
        Of one image.
    """
    shape = images.shape[1:]
    first, width = cell_middle(code, length)
    axis, images = Axis(first, width, code.inverted), np.ascontiguousarray(images)
    cells = Cells(np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32), np.empty(shape, np.int32))

    def fill(begin: int, end: int) -> None:
        bits = Bits(*np.zeros((2, shape[1]), np.int32), *np.zeros((2, shape[1])))
        _fill(begin, end, images, axis, black_white, noise, bits, cells)

    in_threads(fill, shape[0])
    return cells


@kernel
def _fill(begin, end, images, axis: Axis, black_white: Levels, noise: Noise, bits: Bits, cells: Cells):
    """Fill rows `begin` to `end`, not included."""
    for v in range(begin, end):
        for u in range(len(bits.number)):
            bits.low[u], bits.high[u] = black_white.black[v, u], black_white.white[v, u]
        read_bits(images[:, v], axis.inverted, noise, bits)
        for u in range(len(bits.number)):
            number, unsure = bits.number[u], bits.unsure[u]
            cells.number[v, u] = number if unsure == 0 else UNKNOWN
            blurred = 0
            while blurred < BLURRED and unsure & 1:
                number, unsure, blurred = number >> 1, unsure >> 1, blurred + 1
            other = number ^ (2 * unsure - 1) if unsure else number
            if unsure & (unsure - 1) or abs(number - other) > 1:
                continue
            count = 1 << blurred
            cells.middle[v, u] = axis.first + axis.width * (count * (number + other + 1) / 2 - 0.5)
            cells.sigma[v, u] = axis.width * count * WIDTH_SIGMA
