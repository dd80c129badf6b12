"""Files and folders that appear whole or not at all: written to a temporary sibling, then exchanged with what was there.

One process at a time writes a place, and others wait for it: a hidden lock lies beside the place meanwhile. Temporary siblings of
a place whose lock is free are therefore leftovers of a process that was killed, on this machine or, where the file system has
locks across machines (NFS 4, SMB), on another.
"""

import errno
import logging
import os
import re
import shutil
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from filelock import Timeout

from recon import file_locks, interrupts
from recon.errors import InputError
from recon.files import renaming

log = logging.getLogger(__name__)

UNPLACED = ".unplaced"  # in the last of several new folders, until all are in place


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Give a temporary path with the same suffix to write to; on success it becomes `path`, on failure it goes away.

    Where `path` is a link, the file that it leads to is written.
    """
    path = Path(os.path.realpath(path))
    if not path.parent.is_dir():  # the lock's file would make it
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path.parent))
    temporary = _beside(path, "new")
    with named_in_errors(path), alone(path):
        try:
            yield temporary
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def new_folder(path: Path, marker: str) -> Iterator[Path]:
    """Give a temporary folder to fill; on success it takes the place of `path`, on failure it goes away.

    A folder that is already there is replaced if `check_folder` allows it, and deleted once the new one is in its place.
    """
    with new_folders({path: marker}) as (folder,):
        yield folder


@contextmanager
def new_folders(places: Mapping[Path, str]) -> Iterator[tuple[Path, ...]]:
    """Give temporary folders to fill, one a place; on success all take their places, on failure all old folders stay.

    The last folder is exchanged with the old one at once, so that at every moment an old or a new one can be read. The others are
    set aside before and put in place after it, so that none stands beside another age of the last. Where a path is a link, the
    folder that it leads to is replaced. Waits until no other process writes one of them; what stands there then doesn't change
    before the end.

    Parameters
    ----------
    places : path -> marker, as of `check_folder`
    """
    paths = [Path(os.path.realpath(path)) for path in places]
    with ExitStack() as locks:
        for path in sorted(paths):
            _check_writable(path, path.parent)
            path.parent.mkdir(parents=True, exist_ok=True)
            locks.enter_context(alone(path))
        _put_back(paths)
        for path, marker in zip(paths, places.values(), strict=True):
            check_folder(path, marker)
        with named_in_errors(paths[-1]), _exchanged(paths) as temporaries:
            yield temporaries


@contextmanager
def named_in_errors(path: Path) -> Iterator[None]:
    """Name what is being written in an error of the system that names nothing, such as that of a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


@contextmanager
def _exchanged(paths: Sequence[Path]) -> Iterator[tuple[Path, ...]]:
    """Give temporary folders, as `new_folders`, which holds the locks; nothing old is deleted before all new are in place."""
    *others, last = paths
    made = [_beside(path, "new") for path in paths]
    try:
        for folder in made:
            folder.mkdir()
        yield tuple(made)
        with interrupts.held_back():
            if others:
                (made[-1] / UNPLACED).touch()
            for path in others:
                if path.exists():
                    path.rename(_beside(path, "old"))
            _exchange(made[-1], last)
            for folder, path in zip(made, others, strict=False):
                folder.rename(path)
    finally:
        with interrupts.held_back():
            _put_back(paths)


def _exchange(folder: Path, path: Path) -> None:
    """Exchange two folders, or move the first where the second isn't there."""
    if not path.exists():
        folder.rename(path)
    elif not renaming.exchange(folder, path):
        aside = _beside(path, "old")
        path.rename(aside)
        folder.rename(path)
        aside.rename(folder)


def restore(paths: Sequence[Path]) -> None:
    """Put back what a process that was killed in `new_folders` has exchanged in part, and remove its other leftovers.

    Nothing is done where another process is writing.
    """
    paths = [Path(os.path.realpath(path)) for path in paths]
    if any(_leftovers(path) for path in paths):
        with ExitStack() as locks, suppress(Timeout):
            for path in sorted(paths):
                locks.enter_context(alone(path, wait=False))
            _put_back(paths)


def _put_back(paths: Sequence[Path]) -> None:
    """As `restore`, for a process that holds the locks: folders become all new, where the last is, or all old.

    The last new folder holds a mark until all are in place, by which it is known wherever it stands.
    """
    *others, last = paths
    for aside in [] if last.exists() else _leftovers(last, "old"):
        aside.rename(last)
    state = "new" if (last / UNPLACED).exists() else "old"
    for path in others:
        for folder in [] if path.exists() else _leftovers(path, state):
            folder.rename(path)
    (last / UNPLACED).unlink(missing_ok=True)
    for path in paths:
        _remove(_leftovers(path))


def link_tree(source: Path, target: Path, leave_out: Collection[str] = ()) -> None:
    """Let a folder hold the files of another too: as hard links, or as copies where the file system has no links.

    Parameters
    ----------
    leave_out : files and folders in `source`, as paths relative to it
    """

    def link(file: str, name: str) -> None:
        try:
            os.link(file, name)
        except OSError:
            shutil.copy2(file, name)

    def left_out(folder: str, names: list[str]) -> list[str]:
        here = Path(folder).relative_to(source)
        return [name for name in names if (here / name).as_posix() in leave_out]

    shutil.copytree(source, target, copy_function=link, ignore=left_out, dirs_exist_ok=True)


def remove_leftovers(path: Path) -> None:
    """Remove the temporary files and folders that a process which was killed while it wrote `path` has left beside it."""
    path = Path(os.path.realpath(path))
    if _leftovers(path):
        with suppress(Timeout), alone(path, wait=False):  # what another process is writing is no leftover
            _remove(_leftovers(path))


def _remove(entries: Iterable[Path]) -> None:
    for entry in entries:
        shutil.rmtree(entry) if entry.is_dir() else entry.unlink()


def check_folder(path: Path, marker: str, inputs: Iterable[Path] = ()) -> None:
    """Check, before any long work, that a folder can be written at `path`, and that nothing is lost by it.

    Parameters
    ----------
    marker : str
        A file that folders of this kind have and no others, by which one that may be replaced is known.
    inputs : iterable of paths
        Sources of the folder's content.

    Raises
    ------
    InputError
        If something else is there: a file, or a folder that holds files but not `marker`; if `path` is one of the inputs or has
        one in it; or if the place can't be written to.
    """
    path = _checked(path, marker, inputs)
    _check_writable(path, path.parent)


def check_filled_folder(path: Path, marker: str, inputs: Iterable[Path] = ()) -> None:
    """The same of a folder that is filled where it stands, not replaced: of one that is there the parent needn't be writable."""
    path = _checked(path, marker, inputs)
    _check_writable(path, path)


def _checked(path: Path, marker: str, inputs: Iterable[Path]) -> Path:
    """The place itself behind links, where nothing is lost by writing there; InputError otherwise, as of `check_folder`."""
    named, path = path, Path(os.path.realpath(path))
    if path.is_symlink():
        raise InputError(f"{named}: expected a folder or nothing, found a loop of links")
    for source in inputs:
        if Path(os.path.realpath(source)).is_relative_to(path):
            raise InputError(f"{path}: expected a folder apart from what is read, found it to hold {source}")
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: expected a folder or nothing, found a file")
    if path.is_dir() and any(path.iterdir()) and not (path / marker).is_file():
        raise InputError(f"{path}: expected a new or empty folder or one with {marker} to replace, found other files")
    return path


def _check_writable(path: Path, folder: Path) -> None:
    """Check, for what is written at `path`, that entries can be made in a folder, or in the nearest one above that is there."""
    there = next(place for place in (folder, *folder.parents) if place.exists())
    try:
        with TemporaryDirectory(prefix=".", dir=there):
            pass
    except OSError as error:
        raise InputError(f"{path}: expected a place to write to, found {there} not writable: {error.strerror}") from None


@contextmanager
def alone(path: Path, wait: bool = True) -> Iterator[None]:
    """Hold the lock of a place. Where another process, or another thread, holds it: wait, or raise Timeout."""
    path = Path(os.path.realpath(path))
    place = path.with_name(f".{path.name}.lock")

    def announce(holder: str) -> None:
        log.warning("%s: waiting for %s, which is writing it", path, holder)

    with file_locks.held(place, announce if wait else None):
        yield


def _leftovers(path: Path, states: str = "new|old") -> list[Path]:
    """Hidden names beside `path` in one of the states, of any process."""
    name = re.compile(rf"\.{re.escape(path.stem)}\.\d+\.({states}){re.escape(path.suffix)}")
    entries = list(path.parent.iterdir()) if path.parent.is_dir() else []
    return [entry for entry in entries if name.fullmatch(entry.name)]


def _beside(path: Path, state: str) -> Path:
    """A hidden name beside `path`, with the same suffix."""
    return path.with_name(f".{path.stem}.{os.getpid()}.{state}{path.suffix}")
