"""Waiting for a lock that another process holds, and saying so. The system releases it when its holder ends, however it ends."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

PATIENCE_S = 3.0  # after which a wait is announced


@contextmanager
def held(path: Path, announce: Callable[[], None]) -> Iterator[None]:
    """Hold the lock in a file, once no other process or thread does; a long wait is announced once."""
    lock = FileLock(path)
    try:
        lock.acquire(timeout=PATIENCE_S)
    except Timeout:
        announce()
        lock.acquire()
    try:
        yield
    finally:
        lock.release()
