"""What a preview shows: the latest image of each device, its figures, and its faults."""

from collections.abc import Callable
from typing import NamedTuple

from numpy.typing import NDArray


class Picture(NamedTuple):
    """One device's latest image."""

    device: str
    image: NDArray  # (h, w)
    bits: int
    text: str  # figures, in one line
    faults: tuple[str, ...] = ()  # each with the way to mend it


Show = Callable[[Picture], None]
Say = Callable[[str], None]


def hidden(picture: Picture) -> None:
    """Show nothing, where there is no preview."""
