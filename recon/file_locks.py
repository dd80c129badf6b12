"""Locks that one process at a time holds, and who holds them; the system releases one when its holder ends, however it ends.

Relied upon is the system's lock of a file (`flock`; `LockFileEx` on Windows). NFS 4 hands such locks to its server and so keeps
other machines out too; NFS 3 does with its lock daemon, SMB with its usual options. A disk without any locks is used without, and
a warning says so. A process number, which means nothing on another machine, is only told, never looked up.
"""

import errno
import logging
import os
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

from filelock import FileLock, Timeout

log = logging.getLogger(__name__)

LONGEST = 200  # characters of a line that says who holds a lock
PATIENCE_S = 3.0  # after which a wait is announced
WITHOUT_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP)


@contextmanager
def held(path: Path, announce: Callable[[str], None] | None = None) -> Iterator[None]:
    """Hold the lock in a file, which goes away with it; its folder is made, and on failure goes away again if it is empty.

    Parameters
    ----------
    announce : called once with the holder, as of `holder`, if the wait for another process or thread is long
        None doesn't wait.

    Raises
    ------
    Timeout
        If another one holds it, and there is no wait.
    """
    lock, missing = FileLock(path, fallback_to_soft=False), list[Path]()
    try:
        try:
            _acquire(lock, 0.0 if announce is None else PATIENCE_S, missing)
        except Timeout:
            if announce is None:
                raise
            missing += _made_by_holder(path)  # first: the holder may end, and its note with it, while it is announced
            announce(holder(path))
            _acquire(lock, -1.0, missing)
        with suppress(OSError):  # Windows lets nobody write to a file that is locked; a note isn't worth an error
            path.write_text(f"{this_process()}{len(set(missing))} folders made\n", encoding="utf-8")
        try:
            yield
        finally:
            with suppress(OSError):  # Windows refuses, and removes it on release
                path.unlink()  # before the release: whoever waits then sees that its file is gone, and makes a new one
            lock.release()
    except BaseException:
        for folder in missing:
            with suppress(OSError):
                folder.rmdir()
        raise


def _made_by_holder(path: Path) -> list[Path]:
    """Folders that a lock's holder has made for it, the inner ones first: if it fails and can't remove them, who waited does."""
    try:
        made = path.read_text(encoding="utf-8", errors="replace").splitlines()[1].split()[0]
        return list(path.parents)[: int(made)]
    except (OSError, ValueError, IndexError):
        return []


def _acquire(lock: FileLock, timeout_s: float, missing: list[Path]) -> None:
    """Acquire a lock; go on without where the disk has none. Folders made for it are added to `missing`, the inner ones first."""
    folder = Path(lock.lock_file).parent
    while True:
        missing += [place for place in (folder, *folder.parents) if not place.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(timeout=timeout_s)
        except OSError as error:
            if error.errno == errno.ESTALE:  # on NFS: its file went away with the holder before
                continue
            if error.errno == errno.ENOENT and not folder.exists():  # it, too: the holder had made it, and failed
                continue
            if error.errno not in WITHOUT_LOCKS:
                raise
            _warn(Path(lock.lock_file).parent)
        return


@cache
def _warn(folder: Path) -> None:
    log.warning("%s: this disk has no locks; see to it that no other run writes there", folder)


def this_process() -> str:
    """A line that says who holds a lock, and since when."""
    return f"process {os.getpid()} on {platform.node()} since {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC\n"


def holder(path: Path) -> str:
    """Who holds a lock, as of its file, which may be missing by now, or not be written yet."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace")[:LONGEST]
    except OSError:
        text = ""
    return "".join(letter for letter in text.partition("\n")[0] if letter.isprintable()) or "another process"
