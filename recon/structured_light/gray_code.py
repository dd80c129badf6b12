"""Fringe order from Gray code, safe at the borders of the periods."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel
from recon.model.patterns import Fringes, GrayCode
from recon.structured_light.phase import Fringe, Noise
from recon.threads import in_threads

SURE = 3.0  # sigmas between a bit's intensity and its threshold, to call the bit certain
MARGIN = 0.1  # cycle that must lie between a decision on the order and its tipping point


class Orders(NamedTuple):
    """Fringe orders and their trusted pixels. Both (h, w)."""

    order: NDArray[np.int32]
    trusted: NDArray[np.bool_]


class Cells(NamedTuple):
    """The cells of a Gray code on the projector's axis."""

    first: float  # cycles, from the fringes' origin to the middle of the first cell
    width: float  # cycles
    inverted: bool  # each bit's image is followed by its inverse


class Bits(NamedTuple):
    """Readings of a row's pixels, each thread's own. All (w,)."""

    number: NDArray[np.int32]  # of the cell
    unsure: NDArray[np.int32]  # a digit for each bit, 1 where it is uncertain; the finest bit is the last
    low: NDArray[np.float64]  # DN, the darkest that a pixel shows; without inverses
    high: NDArray[np.float64]  # DN, the brightest


class Found(NamedTuple):
    """Orders, and the remainders of cells and phases from whole ones. All (h, w)."""

    order: NDArray[np.int32]
    trusted: NDArray[np.bool_]
    residual: NDArray[np.float32]  # cycles


def fringe_order(
    images: NDArray, code: GrayCode, fringes: Fringes, fringe: Fringe, length: int, noise: Noise
) -> tuple[Orders, NDArray[np.float32]]:
    """Fringe order k of each pixel, so that `x = origin + pitch * (phase / 2 pi + k)`.

    The bits name a cell of the projector axis: half a pitch wide with the complementary bit, one pitch without. The order is
    the one that brings the phase nearest to the middle of the cell, whatever the distance between the code's start and the
    fringes' origin:

        k = round((cell centre - origin) / pitch - phase / 2 pi)

    With the complementary bit the remainder is at most a quarter period, so that a bit misread at a border (which moves the
    cell by one) still gives the right order, a quarter period before the decision tips. Without it the decision tips right at
    the borders of the cells, and pixels within 0.1 period of them are not trusted.

    Neighbouring cells differ in one bit, so one uncertain bit is normal. It is read both ways, and a pixel is trusted if both
    give the same order; one with two uncertain bits is not.

    Without inverses a bit's threshold is midway between the brightest and the darkest that the pixel shows in the code's images
    (or the fringes' crest and trough, for a code of one value). It isn't the fringes' mean: grey fringes pass the projector's
    gamma, black-and-white images don't, and the borders of the bits would move.

    Parameters
    ----------
    images : (code.count, h, w), DN
        In the order of the code: each bit, followed by its inverse where the code has inverses.
    code, fringes : GrayCode, Fringes
        Of one axis and one pitch.
    fringe : Fringe
        The decoded fringes.
    length : int, projector px
        Of the axis.
    noise : Noise
        Of one image.

    Returns
    -------
    orders : Orders
    residual : (h, w) float32, cycles
        Remainder of cell and phase from a whole order, in +-0.5. With the complementary bit the right images spread it evenly
        over +-0.25, whatever the origins.
    """
    first, width = cell_middle(code, length)
    cells = Cells((first - fringes.zero(length)) / code.pitch, width / code.pitch, code.inverted)
    images, shape = np.ascontiguousarray(images), fringe.phase.shape
    orders = Orders(np.zeros(shape, np.int32), np.zeros(shape, np.bool_))
    residual = np.zeros(shape, np.float32)

    def fill(first: int, end: int) -> None:
        bits = Bits(*np.zeros((2, shape[1]), np.int32), *np.zeros((2, shape[1])))
        _fill(first, end, images, cells, fringe, noise, bits, Found(*orders, residual))

    in_threads(fill, shape[0])
    return orders, residual


def cell_middle(code: GrayCode, length: int) -> tuple[float, float]:
    """The middle of a code's first cell as it is drawn, and the width of all cells, on an axis of `length` px : projector px."""
    half = 2 if code.complementary else 1
    width = code.pitch / half
    borders = code.origin(length) + width * np.arange(half * 2**code.bits)
    drawn = np.mean(np.ceil(borders - 1e-9) - 0.5 - borders)  # projector pixels are lit whole
    return float(code.origin(length) + drawn + 0.5 * width), width


@kernel
def _fill(first, end, images, cells: Cells, fringe: Fringe, noise: Noise, bits: Bits, found: Found):
    """Fill the orders of rows `first` to `end`, not included."""
    phase, number = fringe.phase, bits.number
    for v in range(first, end):
        if not cells.inverted:
            _black_and_white(images[:, v], fringe.offset[v], fringe.modulation[v], bits.low, bits.high)
        read_bits(images[:, v], cells.inverted, noise, bits)
        for u in range(phase.shape[1]):
            cycles = cells.first + number[u] * cells.width - phase[v, u] / (2 * math.pi)
            nearest = math.floor(cycles + 0.5)
            found.order[v, u] = nearest
            found.residual[v, u] = cycles - nearest
            unsure = bits.unsure[u]
            other = number[u] ^ (2 * unsure - 1) if unsure else number[u]  # a Gray bit flips its binary digit and all after it
            other_way = math.floor(cells.first + other * cells.width - phase[v, u] / (2 * math.pi) + 0.5)
            one = unsure & (unsure - 1) == 0
            found.trusted[v, u] = one and other_way == nearest and abs(cycles - nearest) < 0.5 - MARGIN


@kernel
def read_bits(images, inverted, noise: Noise, bits: Bits):
    """Read the cells of a row's pixels from its images : (n, w), bit by bit."""
    number, unsure, low, high = bits.number, bits.unsure, bits.low, bits.high
    number[:], unsure[:] = 0, 0
    count = len(images) // 2 if inverted else len(images)
    for i in range(count):
        here, against = (images[2 * i], images[2 * i + 1]) if inverted else (images[i], images[i])
        for u in range(len(number)):
            value = float(here[u])
            if inverted:
                other = float(against[u])
                variance = 2 * noise.read_variance + noise.gain * (value + other)
            else:
                other = (low[u] + high[u]) / 2
                level = noise.gain * (low[u] + high[u])
                variance = noise.read_variance + noise.gain * value + (2 * noise.read_variance + level) / 4
            parity = (number[u] & 1) ^ (1 if value > other else 0)  # the running one turns Gray into binary
            number[u] = 2 * number[u] + parity
            unsure[u] = 2 * unsure[u] + (1 if (value - other) ** 2 < SURE * SURE * variance else 0)


@kernel
def _black_and_white(images, offset, modulation, low, high):
    """The darkest and the brightest that a row's pixels show, over its images of the code and the fringes' trough and crest."""
    for u in range(len(low)):
        low[u] = max(offset[u] - modulation[u], np.float32(0))  # gamma's harmonics pull the fit below black
        high[u] = offset[u] + modulation[u]
    for i in range(len(images)):
        image = images[i]
        for u in range(len(low)):
            low[u], high[u] = min(low[u], float(image[u])), max(high[u], float(image[u]))
