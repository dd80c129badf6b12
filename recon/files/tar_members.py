"""Members of tar files by their places, so that any of them is read without those before it; damage is refused in one line.

Samples lie in WebDataset's layout: members of one sample follow each other, and their names agree up to the first dot.
"""

import os
import tarfile
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

from recon.errors import InputError, reason
from recon.files.regular import opened

DAMAGE = (tarfile.TarError, EOFError, ValueError, OverflowError, RecursionError)  # what the headers of damaged files end in


class Member(NamedTuple):
    """Where a file's content lies in a tar file."""

    name: str
    offset: int  # bytes
    size: int  # bytes


Sample = tuple[str, dict[str, Member]]  # key, and members by the rest of their names


def members(path: Path) -> Iterator[Member]:
    """Files in a tar file that isn't compressed, in order; folders, links and hidden files are left out.

    Raises
    ------
    InputError
        If there is no such file, it isn't a regular one, or it is damaged, cut short, or has a file with holes or one that is
        too large.
    """
    most_bytes = 1 << 28  # of a member; a full frame's PNG has a few MB
    try:
        with opened(path, expected="a tar file") as stream, tarfile.open(fileobj=stream, mode="r:") as archive:
            end, last = os.fstat(stream.fileno()).st_size, -1
            for entry in archive:
                if entry.offset <= last:  # sizes below 0 lead back
                    raise InputError(f"{path}: expected a tar file, found a damaged one: {entry.name!r} has {entry.size} bytes")
                last = entry.offset
                if not entry.isfile() or entry.name.rpartition("/")[2].startswith("."):
                    continue
                if entry.issparse() or not 0 <= entry.size <= most_bytes:
                    found = "one with holes" if entry.issparse() else f"{entry.size}"
                    raise InputError(f"{path}: {entry.name!r}: expected a file of up to {most_bytes} bytes, found {found}")
                if entry.offset_data + entry.size > end:
                    raise InputError(f"{path}: {entry.name!r}: expected {entry.size} bytes, found the tar file cut short")
                yield Member(entry.name, entry.offset_data, entry.size)
    except OSError as error:
        raise InputError(f"{path}: expected a readable tar file, found {error.strerror or error}") from None
    except InputError:
        raise
    except DAMAGE as error:
        raise InputError(f"{path}: expected a tar file, found a damaged one: {reason(error)}") from None


def samples(path: Path) -> Iterator[Sample]:
    """Samples of a shard, in order."""
    for key, some in groupby(members(path), key=lambda member: _split(member.name)[0]):
        yield key, {_split(member.name)[1]: member for member in some}


def read(path: Path, offset: int, size: int) -> bytes:
    """Content of a member.

    Raises
    ------
    InputError
        If the file is gone, isn't a regular one, or has become shorter.
    """
    try:
        with opened(path, expected="a tar file") as stream:
            stream.seek(offset)
            content = stream.read(size)
    except OSError as error:
        raise InputError(f"{path}: expected a readable tar file, found {error.strerror}") from None
    if len(content) < size:
        raise InputError(f"{path}: expected {size} bytes at {offset}, found {len(content)}; was it changed meanwhile?")
    return content


def name_at(path: Path, offset: int) -> str:
    """Name of the member whose content begins at an offset, for messages."""
    return next((member.name for member in members(path) if member.offset == offset), f"at byte {offset}")


def _split(name: str) -> tuple[str, str]:
    """Key and end of a member's name: `folder/0-7.cam1.png` to `folder/0-7`, `cam1.png`."""
    folder, slash, file = name.removeprefix("./").rpartition("/")
    key, _, end = file.partition(".")
    return f"{folder}{slash}{key}", end
