"""Whoever follows a step: hears its lines and its progress; this one in silence, a verb's shows both on its console."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

Thing = TypeVar("Thing")


class Watch:
    """Follows a step in silence."""

    def say(self, line: str) -> None:
        """Hear a line of the step."""

    def announce(self, line: str) -> None:
        """Hear which of several steps begins."""

    def warn(self, line: str) -> None:
        """Hear why a step came to nothing."""

    @contextmanager
    def busy(self, does: str) -> Iterator[None]:
        """Hear of some longer work, the body."""
        yield

    def follow(self, things: Iterable[Thing], total: int, does: str) -> Iterable[Thing]:
        """Pass things on, one by one, and hear how many of their number have come."""
        return things


SILENT = Watch()
