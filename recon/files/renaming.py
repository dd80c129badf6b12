"""Exchange of two folders in one step, where the system has it: at every moment each name leads to the one or to the other."""

import ctypes
import errno
import os
from pathlib import Path

EXCHANGE = 2  # RENAME_EXCHANGE of Linux
UNSUPPORTED = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP)  # by the file system, or by the kernel


def exchange(one: Path, other: Path) -> bool:
    """Exchange two files or folders of one file system; returns whether the system can, and raises OSError if it fails otherwise.

    Linux has it in most file systems (`man 2 renameat2`).
    """
    renameat2 = _renameat2()
    if renameat2 is None:
        return False
    here = -100  # AT_FDCWD: paths are relative to the working folder
    if renameat2(here, os.fsencode(one), here, os.fsencode(other), EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in UNSUPPORTED:
        return False
    raise OSError(number, os.strerror(number), str(other))


def _renameat2() -> "ctypes._NamedFuncPointer | None":
    """The function of the C library; other systems have none."""
    if os.name != "posix":
        return None
    return getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
