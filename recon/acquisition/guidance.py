"""Who works before the devices, and what is to be done next."""

from collections.abc import Sequence
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Answer = Literal["wait", "take", "keep", "drop", "end"]
PENDING = ("wait", "drop")  # where nothing can be dropped


class Step(NamedTuple):
    """What is to be done next."""

    text: str
    world_from_board: Array | None = None  # (4, 4) mm, where a board is best held


class Operator(Protocol):
    """A person before the devices, or what stands in for one."""

    def ask(self, step: Step) -> None:
        """Say what is to be done; returns at once."""

    def answer(self) -> Answer:
        """`take` once it has been done, `keep` to take it whatever is wrong with it, `wait` until then; returns at once.

        `drop` to delete the last one, where single things are taken; `end` if no more is to be recorded.
        """


def sentence(faults: Sequence[str]) -> str:
    """Faults in one line."""
    return "; ".join(faults)
