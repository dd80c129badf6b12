"""Locks that one process at a time holds, and who holds them; the system releases one when its holder ends, however it ends."""

import os
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from filelock import FileLock, Timeout

LONGEST = 200  # characters of a line that says who holds a lock
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
        path.write_text(this_process(), encoding="utf-8")
    try:
        yield
    finally:
        lock.release()


def this_process() -> str:
    """A line that says who holds a lock, and since when."""
    return f"process {os.getpid()} on {platform.node()} since {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC\n"


def holder(path: Path) -> str:
    """Who holds a lock, as of a file with its line, which may be missing yet, or cut short."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace")[:LONGEST]
    except OSError:
        text = ""
    return "".join(letter for letter in text.partition("\n")[0] if letter.isprintable()) or "another process"
