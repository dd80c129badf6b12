"""Files that may be read, and those that never end or are none."""

import os
import socket
import threading
from pathlib import Path

import pytest

from recon.errors import InputError
from recon.files.regular import check_there, opened, read_bytes, read_text

HOSTILE = ("folder", "pipe", "socket", "device", "broken link", "loop", "zero in it", "half a letter", "too long", "pipe's link")


def made(folder: Path, kind: str) -> Path:
    """A path at which something else than a file lies."""
    path = folder / "file"
    match kind:
        case "folder":
            path.mkdir()
        case "pipe":
            os.mkfifo(path)
        case "socket":
            with socket.socket(socket.AF_UNIX) as one:
                here = Path.cwd()
                os.chdir(folder)  # as a socket's path may only be short
                try:
                    one.bind("file")
                finally:
                    os.chdir(here)
        case "device":
            return Path("/dev/zero")
        case "broken link":
            path.symlink_to(folder / "nothing")
        case "loop":
            path.symlink_to(path)
        case "zero in it":
            return folder / "a\0b"
        case "half a letter":
            return folder / "a\ud800"
        case "too long":
            return folder / ("a" * 300)
        case "pipe's link":
            os.mkfifo(folder / "pipe")
            path.symlink_to(folder / "pipe")
    return path


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="has no pipes")
@pytest.mark.parametrize("kind", HOSTILE)
def test_what_is_no_file_is_refused_at_once(tmp_path, kind):
    path = made(tmp_path, kind)
    count = threading.active_count(), len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").is_dir() else 0
    for read in (read_bytes, read_text, lambda path: check_there([path]), lambda path: opened(path).__enter__()):
        with pytest.raises(InputError, match=r"expected (a|the name of a) \w+(?: to read)?, found ") as refusal:
            read(path)
        assert "\n" not in str(refusal.value)
        str(refusal.value).encode()
    after = threading.active_count(), len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").is_dir() else 0
    assert after == count, "left open"


def test_a_file_is_read_whole_up_to_its_bound(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"\xef\xbb\xbfgr\xc3\xa4y\r\n")
    assert read_bytes(path, 10) == path.read_bytes() and read_text(path) == "gräy\r\n"
    (tmp_path / "link").symlink_to(path)
    assert read_bytes(tmp_path / "link", 10) == path.read_bytes()
    check_there([path, tmp_path / "link"])
    with pytest.raises(InputError, match=r"file: expected a file of up to 0 MiB, found 0 MiB"):
        read_bytes(path, 9)
    path.write_bytes(b"gr\xe4y")
    with pytest.raises(InputError, match=r"file: expected a text in UTF-8, found other data at byte 2"):
        read_text(path)
