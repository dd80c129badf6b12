"""Waiting for a lock that another process holds, and saying so. The system releases it when its holder ends, however it ends."""

from collections.abc import Callable

from filelock import BaseFileLock, Timeout

PATIENCE_S = 3.0  # after which a wait is announced


def acquire(lock: BaseFileLock, announce: Callable[[], None]) -> None:
    """Acquire a lock, however long another process holds it; a long wait is announced once."""
    try:
        lock.acquire(timeout=PATIENCE_S)
    except Timeout:
        announce()
        lock.acquire()
