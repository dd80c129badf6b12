"""A folder kept to one run for as long as it works there; a second run is refused, and told who is at work.

Relied upon is the system's lock of a file (`flock`; `LockFileEx` on Windows), which ends with the process that holds it, however
that ends: so what a killed run leaves behind keeps nobody out, and a process number, which means nothing on another host, is
only told, never looked up. NFS 4 hands such locks to its server and so keeps other hosts out too; NFS 3 does with its lock
daemon, SMB with its usual options. A disk without any locks is used without, and a warning says so.
"""

import errno
import logging
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from recon import file_locks
from recon.errors import InputError

log = logging.getLogger(__name__)

WITHOUT_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP)


@contextmanager
def occupied(folder: Path) -> Iterator[None]:
    """Keep a folder, which need not exist yet, to this run; its mark lies beside it meanwhile, so the folder may be replaced.

    Raises
    ------
    InputError
        If another process or thread holds it; the line says which, where, and since when.
    """
    made = [parent for parent in Path(os.path.realpath(folder)).parents if not parent.exists()]
    mark = _mark(Path(os.path.realpath(folder)))
    who = mark.with_name(f"{mark.name}.txt")
    with ExitStack() as after:
        after.callback(_remove_empty, made)
        try:
            after.enter_context(FileLock(mark, blocking=False, fallback_to_soft=False))
        except Timeout:
            raise InputError(
                f"{folder}: expected a folder that no other run is writing, found {file_locks.holder(who)} at work in it; "
                "wait for its end, or choose another folder"
            ) from None
        except OSError as error:
            if error.errno not in WITHOUT_LOCKS:
                raise
            log.warning("%s: this disk has no locks; see to it that no other run writes there", folder)
        after.callback(_remove, (who, mark))  # before the release, so that nobody waits for a name that then goes away
        who.write_text(file_locks.this_process(), encoding="utf-8")  # beside the locked file, which Windows lets nobody read
        yield


def _mark(folder: Path) -> Path:
    """The locked file: beside the folder, or in it where nothing can be written beside it, as with a disk of its own."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    beside = folder.name and os.access(folder.parent, os.W_OK)
    return (folder.parent if beside else folder) / f".{folder.name}.occupied"


def _remove(files: tuple[Path, ...]) -> None:
    for file in files:
        with suppress(OSError):  # Windows refuses while a file is open, and removes a lock on release
            file.unlink()


def _remove_empty(folders: list[Path]) -> None:
    for folder in folders:
        with suppress(OSError):  # something lies there now
            folder.rmdir()
