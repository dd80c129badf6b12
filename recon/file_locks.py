"""Locks that one process at a time holds, and who holds them; the system releases one when its holder ends, however it ends."""

import os
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from filelock import FileLock, Timeout

PATIENCE_S = 3.0  # after which a wait is announced


@contextmanager
def held(path: Path, announce: Callable[[str], None] | None = None) -> Iterator[None]:
    """Hold the lock in a file.

    Parameters
    ----------
    announce : called once with the holder, as of `holder`, if the wait for another process or thread is long
        None doesn't wait.

    Raises
    ------
    Timeout
        If another one holds it, and there is no wait.
    """
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0 if announce is None else PATIENCE_S)
    except Timeout:
        if announce is None:
            raise
        announce(holder(path))
        lock.acquire()
    with suppress(OSError):  # Windows lets nobody write to a file that is locked
        path.write_text(f"process {os.getpid()} of {platform.node()} since {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC\n")
    try:
        yield
    finally:
        lock.release()


def holder(path: Path) -> str:
    """Who holds a lock, as it wrote into the lock's file: process, machine and start."""
    try:
        return path.read_text(encoding="utf-8").strip() or "another process"
    except (OSError, UnicodeDecodeError):
        return "another process"
