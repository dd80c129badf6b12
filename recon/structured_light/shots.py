"""Images of a sequence with what is known of them, and the orders of their fringes."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.model.patterns import Axis, Fringes, Patterns
from recon.structured_light.gray_code import Orders
from recon.structured_light.phase import FrameErrors, Fringe, Noise

Mask = NDArray[np.bool_]
Measured = tuple[Fringes, Fringe]


class Shots(NamedTuple):
    """Images of a sequence, and what is known of them."""

    images: NDArray  # (n, h, w), DN
    patterns: Patterns
    errors: dict[int, FrameErrors]  # of each set of fringes, by the place of its first image
    noise: Noise
    least: float  # DN, of modulation
    full: float  # DN
    name: str
    doubt: str  # of the noise where it is assumed, in words

    def where(self, place: slice) -> str:
        """Images of a part, for messages."""
        return f"{self.name}: images {place.start} to {place.stop - 1}"

    def guide(self, kind: type, axis: Axis) -> tuple:
        """The one part of a kind on an axis, and its place in the sequence."""
        return next((p, at) for p, at in self.patterns.slices() if isinstance(p, kind) and p.axis == axis)


class Ordered(NamedTuple):
    """Fringe orders of an axis."""

    orders: Orders
    unreachable: Mask  # (h, w), pixels whose surface the method can't reach
    counts: dict[str, int]  # for the summary


def finest(sets: list[Measured]) -> Measured:
    """The set of fringes of least pitch, whose orders are asked for."""
    return min(sets, key=lambda pair: pair[0].pitch)
