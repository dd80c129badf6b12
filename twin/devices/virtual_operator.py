"""The hand before the virtual devices: it does at once what it is asked for."""

from collections.abc import Callable

from recon.acquisition.guidance import Answer, Step
from recon.geometry import rigid


class BoardHand:
    """Holds the board where it is asked to, some times at most, and then ends."""

    def __init__(self, hold: Callable[[rigid.Array], None], most: int) -> None:
        self._hold, self._left = hold, most

    def ask(self, step: Step) -> None:
        """Hold the board."""
        self._left -= 1
        if step.world_from_board is not None:
            self._hold(step.world_from_board)

    def answer(self) -> Answer:
        """`take`, or `end` after too many requests."""
        return "end" if self._left < 0 else "take"


class OneTake:
    """Takes once, and keeps what came of it; of a sweep, ends when its path is over."""

    def __init__(self, over: Callable[[], bool] = lambda: True) -> None:
        self._over, self._asked = over, 0

    def ask(self, step: Step) -> None:
        """Count the requests: the first begins, a second one follows when it has been done."""
        self._asked += 1

    def answer(self) -> Answer:
        """`take` at first, then `end` as soon as it is over."""
        if self._asked < 2:
            return "take"
        return "end" if self._over() else "wait"
