"""Regular files of a bounded size, read whole or refused in one line; devices and pipes, which may never end, are none."""

import os
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, TypeVar

from recon.errors import InputError, printable

Answer = TypeVar("Answer")

MOST_BYTES = 1 << 30  # of a file that is read whole
MOST_TEXT = 1 << 26  # bytes of a text whose values are all kept
MOST_TABLE = 1 << 28  # of a table of poses: hours
AT_ONCE = getattr(os, "O_NONBLOCK", 0)  # a pipe that nobody writes to would be waited for
FLAGS = os.O_RDONLY | AT_ONCE | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


@contextmanager
def opened(path: Path, most: int | None = None, expected: str = "a file") -> Iterator[BinaryIO]:
    """Open a regular file to read bytes.

    Parameters
    ----------
    most : bytes that it may have; None for any number
    expected : for the messages

    Raises
    ------
    InputError
        If there is no such file, it isn't a regular one, can't be read, or is larger.
    """
    descriptor = _ask(path, expected, lambda: os.open(path, FLAGS))
    try:
        _check(path, os.fstat(descriptor), most, expected)
        stream = os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise
    with stream:
        yield stream


def read_bytes(path: Path, most: int = MOST_BYTES, expected: str = "a file") -> bytes:
    """Content of a regular file; raises InputError as `opened` does."""
    with opened(path, most, expected) as stream:
        return _ask(path, expected, stream.read)


def read_text(path: Path, most: int = MOST_TEXT, expected: str = "a text") -> str:
    """Content of a regular file as UTF-8, with or without its mark; raises InputError also if it is none."""
    data = read_bytes(path, most, expected)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{shown(path)}: expected {expected} in UTF-8, found other data at byte {error.start}") from None


def check_there(paths: Iterable[Path], expected: str = "a file") -> None:
    """Check that regular files are there, without reading them; InputError names the first that isn't."""
    for path in paths:
        _check(path, _ask(path, expected, lambda path=path: os.stat(path)), None, expected)


def shown(path: Path) -> str:
    """A path for messages: in one line, and of letters that any console takes."""
    return printable(str(path))


def _ask(path: Path, expected: str, call: Callable[[], Answer]) -> Answer:
    """The answer of the system about a file; its refusals as InputError."""
    try:
        return call()
    except FileNotFoundError:
        raise InputError(f"{shown(path)}: expected {expected}, found none") from None
    except OSError as error:
        raise InputError(f"{shown(path)}: expected {expected} to read, found {(error.strerror or str(error)).lower()}") from None
    except ValueError as error:  # of a NUL or half a letter
        raise InputError(f"{shown(path)}: expected the name of {expected}, found {error}") from None


def _check(path: Path, found: os.stat_result, most: int | None, expected: str) -> None:
    """Refuse what isn't a regular file, or a larger one."""
    if not stat.S_ISREG(found.st_mode):
        raise InputError(f"{shown(path)}: expected {expected}, found {KINDS.get(stat.S_IFMT(found.st_mode), 'something else')}")
    if most is not None and found.st_size > most:
        raise InputError(f"{shown(path)}: expected {expected} of up to {most >> 20} MiB, found {found.st_size >> 20} MiB")
