"""What a preview shows: the latest image of each device, its figures, and its faults."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Over(NamedTuple):
    """What is drawn over an image, and said beside it: where something is to be held, and the way there."""

    words: str
    outline: NDArray[np.float64]  # (m, 2) px, of a closed line
    first: NDArray[np.float64]  # (2,) px, a mark in it: which way round
    there: bool  # whether it is held there


class Picture(NamedTuple):
    """One device's latest image."""

    device: str
    image: NDArray  # (h, w)
    bits: int
    text: str  # figures, in one line
    faults: tuple[str, ...] = ()  # each with the way to mend it
    over: Over | None = None


Show = Callable[[Picture], None]
Say = Callable[[str], None]


def hidden(picture: Picture) -> None:
    """Show nothing, where there is no preview."""


def bare(device: str, image: NDArray) -> None:
    """Draw nothing over a device's image : (h, w)."""
