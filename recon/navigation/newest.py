"""A place for one thing: the newest wins, so that a slow reader is late by one thing and never by a queue.

And a queue, for a reader that must miss none.
"""

from collections import deque
from threading import Condition
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Newest(Generic[Item]):
    """One thing that threads hand on. Putting another in replaces it; taking it waits for one."""

    def __init__(self) -> None:
        self._changed = Condition()
        self._item: Item | None = None
        self._closed = False
        self.replaced = 0  # things that nobody took

    def put(self, item: Item) -> None:
        """Leave a thing, in place of the one that is there."""
        with self._changed:
            self.replaced += self._item is not None
            self._item = item
            self._changed.notify()

    def take(self, timeout_s: float) -> Item | None:
        """Wait for a thing and take it out; None if none came in time, or after `close`."""
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None or self._closed, timeout_s)
            item, self._item = self._item, None
            return item

    def close(self) -> None:
        """End all waiting."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class Every(Newest[Item]):
    """Things that threads hand on, each in its turn. Only of very many that nobody takes the oldest go."""

    def __init__(self, most: int = 1000) -> None:
        super().__init__()
        self._items: deque[Item] = deque(maxlen=most)

    def put(self, item: Item) -> None:
        """Leave a thing behind those that are there."""
        with self._changed:
            self.replaced += len(self._items) == self._items.maxlen
            self._items.append(item)
            self._changed.notify()

    def take(self, timeout_s: float) -> Item | None:
        """Wait for a thing and take the oldest out; None if none came in time, or where none is left after `close`."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed, timeout_s)
            return self._items.popleft() if self._items else None
