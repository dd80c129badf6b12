"""Files and folders that appear whole or not at all: written to a temporary sibling, then exchanged with what was there.

One process at a time writes a place, and others wait for it: a hidden lock lies beside the place meanwhile. Temporary siblings of
a place whose lock is free are therefore leftovers of a process that was killed, on this machine or, where the file system has
locks across machines (NFS 4, SMB), on another.
"""

import ctypes
import errno
import logging
import os
import re
import shutil
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType

from filelock import Timeout

from recon import file_locks, interrupts
from recon.errors import InputError
from recon.files import written_files
from recon.files.written_files import LIST, UNPLACED, Addition

log = logging.getLogger(__name__)
EXCHANGE = 2  # RENAME_EXCHANGE of Linux
UNSUPPORTED = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP)  # by the file system, or by the kernel


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Give a temporary path with the same suffix to write to; on success it becomes `path`, on failure it goes away.

    Where `path` is a link, the file that it leads to is written; where it is such a temporary path, that itself.
    """
    path = Path(os.path.realpath(path))
    if re.search(rf"^\..*\.{os.getpid()}\.new(\.|$)", path.name):  # as `_beside` names it
        yield path
        return
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
def new_folder(path: Path, by: str, adds: Addition | None = None) -> Iterator[Path]:
    """Give a temporary folder to fill; on success it takes the place of `path`, on failure it goes away.

    Of a folder that is already there, the files that `by` wrote are replaced if `check_folder` allows it; all else stays in it.
    """
    with new_folders({path: by}, {path: adds} if adds else {}) as (folder,):
        yield folder


@contextmanager
def new_folders(places: Mapping[Path, str], adds: Mapping[Path, Addition] = MappingProxyType({})) -> Iterator[tuple[Path, ...]]:
    """Give temporary folders to fill, one a place; on success all take their places, on failure all is as before.

    The last folder is exchanged with the old one at once, so that at every moment an old or a new one can be read. The others are
    set aside before and put in place after it, so that none stands beside another age of the last. Where a path is a link, the
    folder that it leads to is replaced. Waits until no other process writes one of them; what stands there then doesn't change
    before the end. Files that aren't replaced stay, see `written_files`.

    Parameters
    ----------
    places : path -> who writes it, as of `check_folder`
    adds : path -> part that is added there
    """
    by = {Path(os.path.realpath(path)): name for path, name in places.items()}
    additions = {Path(os.path.realpath(path)): part for path, part in adds.items()}
    paths = list(by)
    with ExitStack() as locks:
        for path in sorted(paths):
            _check_no_file(path)
            _check_writable(path, path.parent)
            locks.enter_context(alone(path))  # which makes its folder
        _put_back(paths)
        for path in paths:
            check_folder(path, by[path], adds=additions.get(path))
        with named_in_errors(paths[-1]), _exchanged(paths) as temporaries:
            yield temporaries
            for folder, path in zip(temporaries, paths, strict=True):
                written_files.complete(folder, path, by[path], additions[path].shared if path in additions else ())
    for path in paths:
        if path not in additions and (others := written_files.foreign(path)):
            log.warning("%s: kept %s, which this run didn't write", path, ", ".join(others[:3]) + " ..." * (len(others) > 3))


def begin_filled(folder: Path, by: str) -> None:
    """Make a folder that is filled where it stands, and list its writer, so that a run that is killed can go on."""
    folder.mkdir(parents=True, exist_ok=True)
    remove_leftovers(folder / LIST)
    if LIST not in (written_files.read_list(folder) or {}):
        _enter(folder, LIST, (written_files.Written(by, 0, ""),))


@contextmanager
def listed_file(folder: Path, name: str, by: str, grows: bool = False) -> Iterator[Path]:
    """As `new_file`, in a folder that is filled where it stands: only a file that `by` wrote is replaced, as it was written.

    Parameters
    ----------
    grows : whether more is appended to the file later

    Raises
    ------
    InputError
        As of `check_listed`.
    """
    path = folder / name
    with new_file(path) as temporary:
        check_listed(folder, name, by)
        yield temporary
        new = written_files.written(temporary, by, grows)
        before = _enter(folder, name, (new,), kept=True)  # either is right until one stands there
        if before == (new,) and path.is_file():
            return
    _enter(folder, name, (new,))


def list_again(folder: Path, name: str, by: str) -> None:
    """List a file that has grown, in a folder that is filled where it stands, as it is now."""
    _enter(folder, name, (written_files.written(folder / name, by, grows=True),))


def check_listed(folder: Path, name: str, by: str) -> None:
    """Check that a file in a folder that is filled where it stands can be written.

    Raises
    ------
    InputError
        If one is there that `by` didn't write, or that was changed since.
    """
    path = folder / name
    if not os.path.lexists(path):
        return
    written_files.check_own(path, (written_files.read_list(folder) or {}).get(name, ()), by)


def remove_listed(folder: Path, names: Iterable[str], by: str) -> None:
    """Remove some files from a folder that is filled where it stands; InputError, and nothing removed, if another's is there."""
    there = [name for name in names if os.path.lexists(folder / name)]
    for name in there:
        check_listed(folder, name, by)
    for name in there:
        (folder / name).unlink()


def _enter(
    folder: Path, name: str, written: tuple[written_files.Written, ...], kept: bool = False
) -> tuple[written_files.Written, ...]:
    """Enter a file into a folder's list, in place of what it says of it or beside that; returns what it said."""
    with new_file(folder / LIST) as temporary:
        files = written_files.read_list(folder) or {}
        before = files.get(name, ())
        files[name] = tuple(dict.fromkeys((*written, *(before if kept else ()))))
        written_files.write_list(temporary, files)
    return before


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
            whole = _beside(last, "whole")
            os.rename(made[-1], whole)
            _exchange(whole, last)
            for folder, path in zip(made, others, strict=False):
                folder.rename(path)
    finally:
        with interrupts.held_back():
            _put_back(paths)


def _exchange(folder: Path, path: Path) -> None:
    """Exchange two folders, or move the first where the second isn't there."""
    if not path.exists():
        folder.rename(path)
    elif not swap(folder, path):
        aside = _beside(path, "old")
        path.rename(aside)
        folder.rename(path)
        aside.rename(folder)


def restore(paths: Sequence[Path]) -> None:
    """Put back what a process that was killed in `new_folders` has exchanged in part, and remove its other leftovers.

    Nothing is done where another process is writing.
    """
    paths = [Path(os.path.realpath(path)) for path in paths]
    if any(_leftovers(path) or _lock_of(path).exists() for path in paths):
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
            if state == "old" or (folder / LIST).is_file():
                folder.rename(path)
    (last / UNPLACED).unlink(missing_ok=True)
    for path in paths:
        _remove(path)


def link_file(source: str | Path, target: str | Path) -> None:
    """Give a file a second place, which is free: as a hard link, or as a copy where the file system has no links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def link_tree(source: Path, target: Path, leave_out: Collection[str] = ()) -> None:
    """Let a folder hold the files of another too, as of `link_file`.

    Parameters
    ----------
    leave_out : files and folders in `source`, as paths relative to it; lists of what sonotwin wrote are always left out
    """

    def left_out(folder: str, names: list[str]) -> list[str]:
        here = Path(folder).relative_to(source)
        return [name for name in names if name == LIST or (here / name).as_posix() in leave_out]

    shutil.copytree(source, target, copy_function=link_file, ignore=left_out, dirs_exist_ok=True)


def remove_leftovers(path: Path) -> None:
    """Remove the temporary files and folders that a process which was killed while it wrote `path` has left beside it."""
    path = Path(os.path.realpath(path))
    if _leftovers(path) or _lock_of(path).exists():
        with suppress(Timeout), alone(path, wait=False):  # what another process is writing is no leftover
            _remove(path)


def _remove(path: Path) -> None:
    """Remove leftovers beside a place, whose lock is held; what others have put into a folder that stood there goes back."""
    for entry in _leftovers(path, "new"):  # wholly ours, perhaps half
        shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
    for entry in _leftovers(path, "whole|old"):
        if entry.is_dir():
            written_files.remove_replaced(entry, path)


def check_folder(path: Path, by: str, inputs: Iterable[Path | None] = (), adds: Addition | None = None) -> None:
    """Check, before any long work, that a folder can be written at `path`, and that nothing is lost by it.

    Parameters
    ----------
    by : str
        Who writes it: a verb, or a function. Only files that it wrote itself may be replaced.
    inputs : iterable of paths
        Sources of the folder's content; None for one that isn't given.
    adds : Addition
        The part that is written into a folder which others may have written, too.

    Raises
    ------
    InputError
        If something else is there: a file, a folder of another's, or one with a file that was changed since; if `path` is one of
        the inputs or has one in it; or if the place can't be written to.
    """
    path = _checked(path, by, inputs, adds)
    _check_writable(path, path.parent)


def check_filled_folder(path: Path, by: str, inputs: Iterable[Path | None] = ()) -> None:
    """As `check_folder`, for a folder that is filled in place: if it is there, its parent needn't be writable."""
    path = _checked(path, by, inputs)
    _check_writable(path, path)


def _checked(path: Path, by: str, inputs: Iterable[Path | None], adds: Addition | None = None) -> Path:
    """The place itself behind links, where nothing is lost by writing there; InputError otherwise, as of `check_folder`."""
    named, path = path, Path(os.path.realpath(path))
    if path.is_symlink():
        raise InputError(f"{named}: expected a folder or nothing, found a loop of links")
    for source in inputs:
        if source is not None and Path(os.path.realpath(source)).is_relative_to(path):
            raise InputError(f"{path}: expected a folder apart from what is read, found it to hold {source}")
    _check_no_file(path)
    if path.is_dir():
        written_files.check_replaceable(path, by, adds)
    return path


def _check_no_file(path: Path) -> None:
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: expected a folder or nothing, found a file")


def _check_writable(path: Path, folder: Path) -> None:
    """Check, for what is written at `path`, that entries can be made in a folder, or in the nearest one above that is there."""
    there = next(place for place in (folder, *folder.parents) if place.exists())
    try:
        with TemporaryDirectory(prefix=".", dir=there):
            pass
    except OSError as error:
        if not there.exists():  # another process has failed meanwhile, and removed what it had made
            _check_writable(path, folder)
            return
        raise InputError(f"{path}: expected a place to write to, found {there} not writable: {error.strerror}") from None


@contextmanager
def alone(path: Path, wait: bool = True) -> Iterator[None]:
    """Hold the lock of a place. Where another process, or another thread, holds it: wait, or raise Timeout."""
    path = Path(os.path.realpath(path))
    place = _lock_of(path)

    def announce(holder: str) -> None:
        log.warning("%s: waiting for %s, which is writing it", path, holder)

    with file_locks.held(place, announce if wait else None):
        yield


def _lock_of(path: Path) -> Path:
    return path.with_name(f".{path.name}.lock")


def _leftovers(path: Path, states: str = "new|whole|old") -> list[Path]:
    """Hidden names beside `path` in one of the states, of any process."""
    name = re.compile(rf"\.{re.escape(path.stem)}\.\d+\.({states}){re.escape(path.suffix)}")
    entries = list(path.parent.iterdir()) if path.parent.is_dir() else []
    return [entry for entry in entries if name.fullmatch(entry.name)]


def _beside(path: Path, state: str) -> Path:
    """A hidden name beside `path`, with the same suffix."""
    return path.with_name(f".{path.stem}.{os.getpid()}.{state}{path.suffix}")


def swap(one: Path, other: Path) -> bool:
    """Exchange two files or folders of one file system in one step: at every moment each name leads to the one or to the other.

    Returns whether the system can, and raises OSError if it fails otherwise. Linux has it in most file systems
    (`man 2 renameat2`).
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
