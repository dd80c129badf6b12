"""Fringe order from Gray code, safe at the borders of the periods."""

import math
from dataclasses import dataclass

import numpy as np
from numba import prange
from numpy.typing import NDArray

from recon.compiled import njit
from recon.model.patterns import Fringes, GrayCode
from recon.structured_light.phase import Fringe, Noise

SURE = 3.0  # sigmas between a bit's intensity and its threshold, to call the bit certain
MARGIN = 0.1  # cycle that must lie between a decision on the order and its tipping point


@dataclass(frozen=True)
class Orders:
    """Fringe orders : (h, w) int32, and where they can be trusted : (h, w) bool."""

    order: NDArray[np.int32]
    trusted: NDArray[np.bool_]


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
        How far cell and phase are from a whole order, in +-0.5. With the complementary bit the right images spread it evenly
        over +-0.25, whatever the origins.
    """
    half = 2 if code.complementary else 1
    cell = code.pitch / half
    borders = code.origin(length) + cell * np.arange(half * 2**code.bits)
    drawn = np.mean(np.ceil(borders - 1e-9) - 0.5 - borders)  # projector pixels are lit whole
    first = (code.origin(length) + drawn + 0.5 * cell - fringes.zero(length)) / code.pitch
    order, trusted, residual = _order(np.ascontiguousarray(images), code.inverted, fringe.phase, fringe.offset, fringe.modulation,
                                      first, 1 / half, noise.read_variance, noise.gain)  # fmt: skip
    return Orders(order, trusted), residual


@njit(parallel=True)
def _order(images, inverted, phase, offset, modulation, first, cell, read, gain):
    height, width = phase.shape
    bits = images.shape[0] // 2 if inverted else images.shape[0]
    order = np.zeros((height, width), np.int32)
    trusted = np.zeros((height, width), np.bool_)
    residual = np.zeros((height, width), np.float32)
    for v in prange(height):
        for u in range(width):
            uncertain, doubt, gray, number = 0, 0, 0, 0
            low, high = 0.0, 0.0
            if not inverted:
                low = max(offset[v, u] - modulation[v, u], np.float32(0))  # gamma's harmonics pull the fit below black
                high = offset[v, u] + modulation[v, u]
                for i in range(bits):
                    low, high = min(low, float(images[i, v, u])), max(high, float(images[i, v, u]))
            for i in range(bits):
                if inverted:
                    value, other = float(images[2 * i, v, u]), float(images[2 * i + 1, v, u])
                    variance = 2 * read + gain * (value + other)
                else:
                    value, other = float(images[i, v, u]), (low + high) / 2
                    variance = read + gain * value + (2 * read + gain * (low + high)) / 4
                gray ^= 1 if value > other else 0  # running parity turns Gray into binary
                number = 2 * number + gray
                if (value - other) ** 2 < SURE * SURE * variance:
                    uncertain += 1
                    doubt = (1 << (bits - i)) - 1  # a Gray bit flips its binary digit and all after it
            cycles = first + number * cell - phase[v, u] / (2 * math.pi)
            nearest = math.floor(cycles + 0.5)
            order[v, u] = nearest
            residual[v, u] = cycles - nearest
            other_way = math.floor(first + (number ^ doubt) * cell - phase[v, u] / (2 * math.pi) + 0.5)
            trusted[v, u] = uncertain <= 1 and other_way == nearest and abs(cycles - nearest) < 0.5 - MARGIN
    return order, trusted, residual
