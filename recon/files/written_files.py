"""The list of files that sonotwin wrote into a folder, kept in it, by which they are known from what others put there.

`.sonotwin.json` names each file with who wrote it, its size and its SHA-256. Only files that it names are ever replaced or
removed, by who wrote them, and only while they are as they were written. All else in a folder stays where it is.
"""

import hashlib
import json
import logging
import os
import shutil
import stat
import time
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from recon.errors import InputError, short
from recon.files import json_text

log = logging.getLogger(__name__)

LIST = ".sonotwin.json"
SCHEMA = "sonotwin-written/1"
UNPLACED = ".sonotwin.unplaced"  # in the last of several new folders, until all are in place
ELSEWHERE = "move it away, or give another place"  # the way on


@dataclass(frozen=True)
class Written:
    """A file as it was written."""

    by: str  # verb or function
    size: int  # bytes
    sha256: str
    grows: bool = False  # whether more may have been appended since


@dataclass(frozen=True)
class Addition:
    """A part that is added, or written anew, to a folder into which several write: one that has the first of the shared files."""

    shared: tuple[str, ...]  # files that are replaced whoever wrote them, as the new ones take over what they hold
    part: str | None = None  # the part's folder


Files = dict[str, tuple[Written, ...]]  # by path within the folder; two of a file that is being replaced where it stands
_known: dict[tuple[int, ...], str] = {}  # digests by device, inode, size and times: files are read once a process


def read_list(folder: Path) -> Files | None:
    """The list in a folder, None if it has none; InputError if it is damaged."""
    path = folder / LIST
    if path.is_symlink():
        raise InputError(f"{path}: expected the list of files that sonotwin wrote here, found a link; {ELSEWHERE}")
    if not path.is_file():
        return None
    content = json_text.read(path, "a list of files that sonotwin wrote")
    try:
        if content["schema"] != SCHEMA:
            raise KeyError(SCHEMA)
        return {
            str(name): tuple(
                Written(str(one["by"]), int(one["size"]), str(one["sha256"]), bool(one.get("grows"))) for one in each
            )
            for name, each in content["files"].items()
            if each
        }
    except (KeyError, TypeError, ValueError, AttributeError):
        expected = "expected the list of files that sonotwin wrote here"
        raise InputError(f"{path}: {expected}, found damaged data; give another place, or move {folder} away") from None


def write_list(path: Path, files: Files) -> None:
    """Write a list."""
    told = {
        name: [{key: value for key, value in vars(one).items() if value is not False} for one in files[name]] for name in files
    }
    path.write_text(json.dumps({"schema": SCHEMA, "files": dict(sorted(told.items()))}, indent=1) + "\n", encoding="utf-8")


def written(path: Path, by: str, grows: bool = False) -> Written:
    """A file as it is now."""
    return Written(by, path.stat().st_size, _sha256(path), grows)


def is_unchanged(path: Path, files: tuple[Written, ...]) -> bool:
    """Whether a regular file is as it was written."""
    there = path.lstat()
    if not stat.S_ISREG(there.st_mode):
        return False
    begun = [one for one in files if one.grows and one.size <= there.st_size]
    if any(hashlib.sha256(_beginning(path, one.size)).hexdigest() == one.sha256 for one in begun):
        return True
    alike = [one for one in files if one.size == there.st_size]
    return bool(alike) and _sha256(path) in {one.sha256 for one in alike}


def check_own(path: Path, listed: tuple[Written, ...], by: str) -> None:
    """Check that `by` wrote a file, as it stands there; InputError else."""
    writer = listed[0].by if listed else None
    if writer == by and is_unchanged(path, listed):
        return
    found = {None: "another file", by: "it changed since"}.get(writer, f"that of {writer}")
    raise InputError(f"{path}: expected nothing or a file as {by} wrote it, found {found}; {ELSEWHERE}")


def _beginning(path: Path, size: int) -> bytes:
    with path.open("rb") as file:
        return file.read(size)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        there = os.fstat(file.fileno())
        key = there.st_dev, there.st_ino, there.st_size, there.st_mtime_ns, there.st_ctime_ns
        if key in _known:
            return _known[key]
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    rested_ns = 2_000_000_000  # after which a file's times tell one change from the next
    if abs(time.time_ns() - max(there.st_mtime_ns, there.st_ctime_ns)) > rested_ns:
        _known[key] = digest
    return digest


def entries(folder: Path) -> set[str]:
    """All in a folder but its list and folders that hold something: files, links, which aren't followed, and empty folders.

    Nothing of a folder that isn't there.

    Raises
    ------
    OSError
        If a folder can't be read, of which there may be more than is seen.
    """
    found = set[str]()
    for place, folders, files in os.walk(folder, onerror=_raise_error):
        links = [name for name in folders if os.path.islink(os.path.join(place, name))]
        inside = PurePosixPath(Path(place).relative_to(folder).as_posix())
        found |= {str(inside / name) for name in (*files, *links)}
        if not folders and not files and inside.name:
            found.add(str(inside))
    return {name for name in found if not _is_mark(folder, name)}


def _raise_error(error: OSError) -> None:
    if not isinstance(error, FileNotFoundError):  # of another process at work there, whose folder has gone
        raise error


def _is_mark(folder: Path, name: str) -> bool:
    """Whether a name in a folder is that of its list, of a temporary file of it, or of a mark of a process at work there."""
    return name in (LIST, UNPLACED, f".{folder.name}.occupied") or name.startswith(f".{LIST.removesuffix('json')}")


def check_replaceable(folder: Path, by: str, adds: Addition | None = None) -> None:
    """Check that `by` may write into a folder: a new or empty one, one that it has written before, or one to which it adds.

    Raises
    ------
    InputError
        If the folder, or the part, is of others, or a file that would be replaced isn't as it was written, or can't stay where it
        is.
    """
    files, top = read_list(folder), sorted(name for name in os.listdir(folder) if not _is_mark(folder, name))
    if not top:
        return
    there = entries(folder)
    if adds is None or not (folder / adds.shared[0]).is_file():
        _check_owner(folder, by, files, top[0])
        files = files or {}
        replaced = [name for name in there & files.keys() if files[name][0].by == by]
    else:
        files = files or {}
        replaced = _of_part(folder, there, files, adds.part)
    for name in sorted(replaced):
        check_own(folder / name, files.get(name, ()), by)
    for name in sorted(files):
        if blocking := next((parent for parent in _above(name) if parent in there), None):
            raise InputError(f"{folder / blocking}: expected a folder that {by} wrote, found something else; {ELSEWHERE}")
    device = folder.stat().st_dev
    for name in sorted(there - files.keys()):
        if os.path.lexists(folder / name) and (folder / name).lstat().st_dev != device:
            raise InputError(f"{folder / name}: expected it on the disk of {folder}, found another disk; give another place")


def _of_part(folder: Path, there: Collection[str], files: Files, part: str | None) -> list[str]:
    """Files of a part: those that are listed or, if none is, all that are of no other list."""
    inside = [name for name in there if part is not None and PurePosixPath(name).is_relative_to(part)]
    return [name for name in inside if name in files] or [
        name
        for name in inside
        if not _is_folder(folder / name) and not any((folder / above / LIST).is_file() for above in _above(name))
    ]


def _check_owner(folder: Path, by: str, files: Files | None, first: str) -> None:
    """Refuse a folder into which another has written."""
    expected = f"expected a new or empty folder, or one that {by} wrote"
    others = {one.by for each in (files or {}).values() for one in each}
    if files is None:
        found = f"found other files, such as {short(first)}, and no list of ours ({LIST}), as earlier versions wrote none"
        raise InputError(f"{folder}: {expected}, {found}; give another place, or move this folder away")
    if by not in others:
        found = " and ".join(sorted(others)) or "others"
        raise InputError(f"{folder}: {expected}, found one of {found}; give another place, or move this folder away")


def complete(new: Path, old: Path, by: str, shared: Collection[str] = ()) -> None:
    """List the files of a new folder, and let it hold all of the old one's that it doesn't replace, as links to the same files.

    Parameters
    ----------
    shared : as of `Addition`

    Raises
    ------
    InputError
        If a file of the new folder would take the place of one that `by` didn't write, or that isn't as it was written.
    """
    before, there = (read_list(old) or {}, entries(old)) if old.is_dir() else ({}, set[str]())
    files = Files()
    for path in new.rglob(LIST):  # of folders that were made within this one, and are its own
        path.unlink()
    made = entries(new)
    replaced = "replaced"  # instead of a writer: a file of another's whose content was taken over
    for name in sorted(made):
        here, earlier = new / name, old / name
        if blocking := next((parent for parent in _above(name) if parent in there), None):
            raise InputError(f"{old / blocking}: expected a folder for {name}, found something else; {ELSEWHERE}")
        if _is_folder(here) and (name not in there or _is_folder(earlier)):
            continue
        listed = before.get(name, ()) if name in there else ()
        unchanged = bool(listed) and is_unchanged(earlier, listed)
        own = unchanged and listed[0].by == by
        if name in there and _same(here, earlier):
            files |= {name: listed} if listed else {}
        elif name in shared and earlier.is_file() and not own:
            files[name] = written(here, by), written(earlier, replaced)
        elif name in there and not own and _alike(here, earlier):
            if not unchanged:  # what is listed may be a copy, where there are no links
                here.unlink()
                _carry(old, new, name)
            files |= {name: listed} if listed else {}
        else:
            if name in there:
                check_own(earlier, listed, by)
            files[name] = (written(here, by),)
    for name in sorted(there - made):
        if name in before and before[name][0].by == by:
            check_own(old / name, before[name], by)
            continue
        if any(parent in made for parent in _above(name)) or (not (old / name).is_dir() and (new / name).is_dir()):
            raise InputError(f"{old / name}: expected a place for what {by} writes there, found something of others; {ELSEWHERE}")
        files |= {name: before[name]} if name in before else {}
        _carry(old, new, name)
    write_list(new / LIST, files)


def is_whole(folder: Path) -> bool:
    """Whether a folder holds all files that its list names, of which there are some, as they were written."""
    files = _readable_list(folder)
    there = bool(files) and files.keys() <= entries(folder)
    return there and all(_is_folder(folder / name) or is_unchanged(folder / name, files[name]) for name in files)


def foreign(folder: Path) -> list[str]:
    """What lies in a folder at its top, or has something in it, that its list doesn't name."""
    return sorted({name.partition("/")[0] for name in entries(folder) - (read_list(folder) or {}).keys()})


def remove_replaced(left: Path, place: Path) -> None:
    """Remove a folder that was replaced: the files that sonotwin wrote, and links to files of the new one; move all else over.

    What can't be moved stays, and is named.
    """
    files, others = _readable_list(left), _readable_list(place)
    for name in sorted(entries(left)):
        path, other = left / name, place / name
        listed = (*files.get(name, ()), *others.get(name, ()))
        try:
            if os.path.lexists(other) and (_same(path, other) or _is_folder(path)):
                _remove(path)
            elif is_unchanged(path, listed) and (name not in others or os.path.lexists(other)):
                path.unlink()
            elif place.is_dir() and not os.path.lexists(other):
                _make_folders(left, place, name)
                path.rename(other)
            else:
                log.warning("%s: left there, as sonotwin didn't write it", path)
        except PermissionError as error:  # in a folder that its owner protects
            log.warning("%s: left there: %s", path, error.strerror)
    _remove_empty(left, set())


def discard(folder: Path, *by: str) -> None:
    """Remove the files that some writers wrote into a folder and those below, by their lists; what others put there stays."""
    empty = {name for name in entries(folder) if (folder / name).is_dir()}
    for path in sorted(folder.rglob(LIST), reverse=True):
        listed, files = path.parent, _readable_list(path.parent)
        for name in entries(listed) & files.keys():
            if files[name][0].by in by and is_unchanged(listed / name, files[name]):
                (listed / name).unlink()
        if all(_is_folder(listed / name) for name in entries(listed)):
            path.unlink()
    _remove_empty(folder, empty)


def _readable_list(folder: Path) -> Files:
    """A list; nothing of one that is missing or damaged."""
    try:
        return read_list(folder) or {}
    except InputError:
        return {}


def _remove_empty(folder: Path, kept: Collection[str]) -> None:
    """Remove the folders below and the folder itself, as far as they hold nothing but a list, apart from some."""
    if all(_is_folder(folder / name) for name in entries(folder)):
        for name in (LIST, UNPLACED):
            (folder / name).unlink(missing_ok=True)
    for place, _, _ in os.walk(folder, topdown=False):
        if Path(place).relative_to(folder).as_posix() not in kept:
            with suppress(OSError):
                os.rmdir(place)


def _remove(path: Path) -> None:
    path.rmdir() if _is_folder(path) else path.unlink()


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _above(name: str) -> Iterator[str]:
    """Folders on the way to a file, within its folder."""
    return (str(parent) for parent in PurePosixPath(name).parents if parent.name)


def _same(one: Path, other: Path) -> bool:
    """Whether both are the same file, links themselves not followed."""
    return os.path.samestat(one.lstat(), other.lstat())


def _alike(one: Path, other: Path) -> bool:
    """Whether both are regular files of the same bytes."""
    regular = all(stat.S_ISREG(path.lstat().st_mode) for path in (one, other))
    return regular and one.stat().st_size == other.stat().st_size and _sha256(one) == _sha256(other)


def _carry(old: Path, new: Path, name: str) -> None:
    """Let a new folder hold an entry of the old one too; one that can't have two names is moved later, by `remove_replaced`."""
    _make_folders(old, new, name)
    if _is_folder(old / name):
        (new / name).mkdir(exist_ok=True)
        shutil.copystat(old / name, new / name)
        return
    with suppress(OSError, NotImplementedError):
        os.link(old / name, new / name, follow_symlinks=False)


def _make_folders(old: Path, new: Path, name: str) -> None:
    """Make the folders above an entry, as they are in the old place."""
    for above in reversed(list(_above(name))):
        if not (new / above).exists():
            (new / above).mkdir()
            shutil.copystat(old / above, new / above)
