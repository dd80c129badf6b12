"""Files and folders that appear whole or not at all: written to a temporary sibling, then renamed."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from recon.errors import InputError


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Give a temporary path with the same suffix to write to; on success it becomes `path`, on failure it goes away."""
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
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
    temporary, aside = (path.with_name(f".{path.name}.{os.getpid()}.{state}") for state in ("new", "old"))
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


def check_folder(path: Path, marker: str) -> None:
    """Check, before any long work, that a folder can be written at `path`.

    Raises
    ------
    InputError
        If something else is there: a file, or a folder that holds files but not `marker`, by which a folder of the same kind is
        known; or if the place can't be written to.
    """
    path = Path(os.path.abspath(path))
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: expected a folder or nothing, found a file")
    if path.is_dir() and any(path.iterdir()) and not (path / marker).is_file():
        raise InputError(f"{path}: expected a new or empty folder or one with {marker} to replace, found other files")
    parent = next(parent for parent in path.parents if parent.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(f"{path}: expected a place to write to, found {parent} not writable")
