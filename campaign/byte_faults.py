"""Faults of any file: gone, empty, cut, something else in its place."""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

Content = bytes | Callable[[], bytes]  # a function where it is long in the making
HUGE = 1 << 36  # bytes, of a file without content: it takes no room on the disk


@dataclass(frozen=True)
class Fault:
    """A fault that a file can have."""

    name: str
    apply: Callable[[Path], object]  # to the file, which is a link to a valid one: it must be replaced, not written to


def replaced(content: Content) -> Callable[[Path], None]:
    """Give a file that content."""

    def apply(path: Path) -> None:
        path.unlink()
        path.write_bytes(content if isinstance(content, bytes) else content())

    return apply


def faults_of_any_file(path: Path) -> Iterator[Fault]:
    """Faults of a valid file of any kind."""
    content = path.read_bytes()
    noise = np.random.default_rng(len(content)).integers(0, 256, 4096, np.uint8).tobytes()
    yield Fault("gone", Path.unlink)
    yield Fault("empty", replaced(b""))
    yield Fault("noise", replaced(noise))
    yield Fault("zeros", replaced(bytes(1 << 20)))
    yield Fault("a sentence", replaced("Hochgeschätzte Kollegen, anbei die Daten\n".encode("latin-1")))
    yield Fault("only line breaks", replaced(b"\n" * 4096))
    yield Fault("only brackets", replaced(b"[" * 200_000))
    yield Fault("64 GB of nothing", lambda path: (path.unlink(), path.touch(), os.truncate(path, HUGE)))
    yield Fault("a folder", lambda path: (path.unlink(), path.mkdir()))
    yield Fault("a pipe", lambda path: (path.unlink(), os.mkfifo(path)))
    yield Fault("a socket's place", lambda path: (path.unlink(), os.mknod(path, 0o140600)))
    yield Fault("a link to itself", lambda path: (path.unlink(), path.symlink_to(path.name)))
    yield Fault("a link to nothing", lambda path: (path.unlink(), path.symlink_to("nowhere")))
    yield Fault("a link to endless zeros", lambda path: (path.unlink(), path.symlink_to("/dev/zero")))
    yield Fault("a link to endless noise", lambda path: (path.unlink(), path.symlink_to("/dev/urandom")))


def cut_faults(content: bytes) -> Iterator[tuple[str, bytes]]:
    """A file that was cut short."""
    yield "half", content[: len(content) // 2]
    yield "the first 200 bytes", content[:200]
