"""Light of a projector's raster as a camera's pixels see it: mirrors behind a blurred, defocused lens.

A pattern is a staircase of mirrors, each a box of one projector px. The projector's lens blurs it by a Gaussian, by the disc
of its defocus and, as the camera sees it, by that camera's own blur and pixel, all carried to projector px by the slope of the
projector coordinate over the image. A pixel then sees the sum of the mirrors' values with weights, which are in closed form but
for the disc, a few points of Gauss and Chebyshev's rule.

Sources: docs/physics-optics.md, section 2; Abramowitz and Stegun 1964, 25.4.40 for the rule.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel
from recon.threads import in_threads

Array = NDArray[np.float64]

TAILS = 4.5  # standard deviations: 3e-6 of a normal distribution lie beyond one side
LEAST_BOX = 0.02  # projector px: narrower pixels are taken for this wide, 2e-5 px^2 of variance


class Footprint(NamedTuple):
    """What pixels see of the raster along an axis. All (p,)."""

    variance: Array  # projector px^2, of all Gaussian blurs together
    box: Array  # projector px, width of the pixel
    disc: Array  # projector px, diameter of the disc of defocus


class MirrorWeights(NamedTuple):
    """Weights of m neighbouring mirrors in what p pixels see, and their slopes. All (p, m), but for the first."""

    first: NDArray[np.int64]  # (p,) number of the first mirror
    value: Array
    by_place: Array  # a projector px
    by_variance: Array  # a projector px^2
    by_disc: Array  # a projector px


def mirror_weights(place: Array, footprint: Footprint) -> MirrorWeights:
    """Weights of the mirrors around projector coordinates : (p,) px.

    A mirror's weight is its box blurred by the pixel's box, the Gaussian and the disc, at the distance of the mirror's middle.
    """
    footprint = footprint._replace(box=np.maximum(footprint.box, LEAST_BOX))
    reach = TAILS * np.sqrt(footprint.variance) + footprint.box / 2 + footprint.disc / 2 + 0.5
    half = math.ceil(reach.max()) if reach.size else 1
    first = np.floor(place).astype(np.int64) - half + 1
    edges = np.zeros((4, len(place), 2 * half + 1))  # of 2 half mirrors: the share of the light before each edge
    in_threads(_before_edges, len(place), place - first + 0.5, *footprint, edges)
    return MirrorWeights(first, *(edges[:, :, :-1] - edges[:, :, 1:]))


@kernel
def _before_edges(first, end, distance, variance, box, disc, edges):
    """Integrals of a footprint up to the left edges of mirrors, and their slopes, of pixels `first` to `end`, not included.

    The Gaussian's integral over a box is the difference of its second integral, `t Phi(t / s) + s phi(t / s)`.
    """
    for i in range(first, end):
        sigma, half = math.sqrt(variance[i]), box[i] / 2
        points = 4 + int(1.5 * disc[i] / math.sqrt(variance[i] + half * half / 3))
        for k in range(1, points + 1):
            angle = math.pi * k / (points + 1)
            along, share = math.cos(angle) / 2, 2 / (points + 1) * math.sin(angle) ** 2 / box[i]
            for j in range(edges.shape[2]):
                middle = distance[i] - j - along * disc[i]
                right, left = (middle + half) / sigma, (middle - half) / sigma
                above, below = 0.5 * (1 + math.erf(right / math.sqrt(2.0))), 0.5 * (1 + math.erf(left / math.sqrt(2.0)))
                high = math.exp(-right * right / 2) / math.sqrt(2 * math.pi)
                low = math.exp(-left * left / 2) / math.sqrt(2 * math.pi)
                slope = share * (above - below)
                edges[0, i, j] += share * sigma * (right * above + high - left * below - low)
                edges[1, i, j] += slope
                edges[2, i, j] += share * (high - low) / (2 * sigma)
                edges[3, i, j] -= along * slope
