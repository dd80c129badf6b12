"""Files and folders that appear whole or not at all: written to a temporary sibling, then renamed."""

import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from recon.errors import InputError


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Give a temporary path with the same suffix to write to; on success it becomes `path`, on failure it goes away."""
    path = Path(path)
    temporary = _beside(path, "new")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def new_folder(path: Path, marker: str) -> Iterator[Path]:
    """Give a temporary folder to fill; on success it takes the place of `path`, on failure it goes away.

    A folder that is already there is replaced if `check_folder` allows it: set aside, and deleted once the new one is there.
    """
    path = Path(os.path.abspath(path))
    check_folder(path, marker)
    remove_leftovers(path)
    temporary, aside = _beside(path, "new"), _beside(path, "old")
    try:
        temporary.mkdir(parents=True)
        yield temporary
        if path.exists():
            path.rename(aside)
        try:
            temporary.rename(path)
        except OSError:
            if aside.exists():
                aside.rename(path)
            raise
        shutil.rmtree(aside, ignore_errors=True)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def remove_leftovers(path: Path) -> None:
    """Remove the temporary files and folders that a process which was killed while it wrote `path` has left beside it."""
    path = Path(path)
    name = re.compile(rf"\.{re.escape(path.stem)}\.(\d+)\.(new|old){re.escape(path.suffix)}")
    for entry in list(path.parent.iterdir()) if path.parent.is_dir() else ():
        match = name.fullmatch(entry.name)
        if match and not _runs(int(match[1])):
            shutil.rmtree(entry) if entry.is_dir() else entry.unlink()


def check_folder(path: Path, marker: str, inputs: Iterable[Path] = ()) -> None:
    """Check, before any long work, that a folder can be written at `path`, and that nothing is lost by it.

    Parameters
    ----------
    marker : str
        A file that folders of this kind have and no others, by which one that may be replaced is known.
    inputs : iterable of paths
        What the folder is going to be made from.

    Raises
    ------
    InputError
        If something else is there: a file, or a folder that holds files but not `marker`; if `path` is one of the inputs or has
        one in it; or if the place can't be written to.
    """
    path = Path(os.path.abspath(path))
    for source in inputs:
        if Path(source).resolve().is_relative_to(path.resolve()):
            raise InputError(f"{path}: expected a folder apart from what is read, found it to hold {source}")
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: expected a folder or nothing, found a file")
    if path.is_dir() and any(path.iterdir()) and not (path / marker).is_file():
        raise InputError(f"{path}: expected a new or empty folder or one with {marker} to replace, found other files")
    parent = next(parent for parent in path.parents if parent.exists())
    try:
        with TemporaryDirectory(prefix=".", dir=parent):
            pass
    except OSError as error:
        raise InputError(f"{path}: expected a place to write to, found {parent} not writable: {error.strerror}") from None


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # somebody else's
        return True
    return True


def _beside(path: Path, state: str) -> Path:
    """A hidden name beside `path` that no other process uses, with the same suffix."""
    return path.with_name(f".{path.stem}.{os.getpid()}.{state}{path.suffix}")
