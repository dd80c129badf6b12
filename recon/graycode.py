"""Fringe order from Gray code, safe at the borders of the periods."""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.patterns import Fringes, GrayCode
from recon.phase import Fringe, Noise

SURE = 3.0  # sigmas between a bit's intensity and its threshold, to call the bit certain
MARGIN = 0.1  # cycle that must lie between a decision on the order and its tipping point


@dataclass(frozen=True)
class Orders:
    """Fringe orders : (h, w) int32, and where they can be trusted : (h, w) bool."""

    order: NDArray[np.int32]
    trusted: NDArray[np.bool_]


def fringe_order(images: NDArray, code: GrayCode, fringes: Fringes, fringe: Fringe, length: int, noise: Noise) -> Orders:
    """Fringe order k of each pixel, so that `x = origin + pitch * (phase / 2 pi + k)`.

    The bits name a cell of the projector axis: half a pitch wide with the complementary bit, one pitch without. The order is
    the one that brings the phase nearest to the middle of the cell, whatever the distance between the code's start and the
    fringes' origin:

        k = round((cell centre - origin) / pitch - phase / 2 pi)

    With the complementary bit the remainder is at most a quarter period, so that a bit misread at a border (which moves the
    cell by one) still gives the right order, a quarter period before the decision tips. Without it the decision tips right at
    the borders of the cells, and pixels within 0.1 period of them are not trusted.

    Neighbouring cells differ in one bit, so one uncertain bit is normal; a pixel with two is not trusted.

    Parameters
    ----------
    images : (code.count, h, w), DN
        In the order of the code: each bit, followed by its inverse where the code has inverses.
    code, fringes : GrayCode, Fringes
        Of one axis and one pitch.
    fringe : Fringe
        The decoded fringes; their offset is the threshold of the bits.
    length : int, projector px
        Of the axis.
    noise : Noise
        Of one image.

    Returns
    -------
    Orders
    """
    half = 2 if code.complementary else 1
    cell = code.pitch / half
    return Orders(*_order(np.ascontiguousarray(images), code.inverted, fringe.phase, fringe.offset,
                          (code.origin(length) + 0.5 * cell - fringes.zero(length)) / code.pitch, 1 / half,
                          noise.read_variance, noise.gain))  # fmt: skip


@njit(cache=True, parallel=True)
def _order(images, inverted, phase, offset, first, cell, read, gain):
    height, width = phase.shape
    bits = images.shape[0] // 2 if inverted else images.shape[0]
    order = np.zeros((height, width), np.int32)
    trusted = np.zeros((height, width), np.bool_)
    for v in prange(height):
        for u in range(width):
            uncertain, gray, number = 0, 0, 0
            for i in range(bits):
                if inverted:
                    value, other = float(images[2 * i, v, u]), float(images[2 * i + 1, v, u])
                    variance = 2 * read + gain * (value + other)
                else:
                    value, other = float(images[i, v, u]), float(offset[v, u])
                    variance = read + gain * value
                gray ^= 1 if value > other else 0  # running parity turns Gray into binary
                number = 2 * number + gray
                if (value - other) ** 2 < SURE * SURE * variance:
                    uncertain += 1
            cycles = first + number * cell - phase[v, u] / (2 * math.pi)
            nearest = math.floor(cycles + 0.5)
            order[v, u] = nearest
            trusted[v, u] = uncertain <= 1 and abs(cycles - nearest) < 0.5 - MARGIN
    return order, trusted
