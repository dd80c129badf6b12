"""Who works in a folder keeps others out while alive, and not a moment longer."""

import errno
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from contextlib import contextmanager, suppress

import pytest

from recon import file_locks
from recon.errors import InputError
from recon.files import atomic
from recon.files.occupied import occupied

HOLDER = """
import os, signal, sys
from pathlib import Path
from recon.files.occupied import occupied
with occupied(Path(sys.argv[1])):
    if len(sys.argv) > 2:
        if os.fork() == 0:
            print("held", flush=True)  # once the child has given up what it has of its parent's lock
            signal.pause()
    else:
        print("held", flush=True)
    signal.pause()
"""


@contextmanager
def held_elsewhere(folder, *more):
    """Another process that holds the folder; one of its group may outlive it until the end."""
    running = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(folder), *more], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        assert running.stdout.readline() == "held\n"
        yield running
    finally:
        with suppress(ProcessLookupError):  # ended already
            os.killpg(running.pid, signal.SIGKILL)
        running.wait()
        running.stdout.close()


def test_a_second_run_is_told_who_is_at_work(tmp_path):
    folder = tmp_path / "out"
    with held_elsewhere(folder) as running:
        with pytest.raises(InputError) as caught, occupied(folder):
            pass
        assert running.poll() is None  # the other is still there
        line = str(caught.value)
        assert re.match(
            rf"{folder}: expected .* found process {running.pid} on {re.escape(socket.gethostname())} since 20..-", line
        )
        assert "\n" not in line
        with occupied(tmp_path / "other"):  # a neighbour isn't in the way
            pass


@pytest.mark.parametrize("more", [(), ("fork",)])
def test_a_killed_run_keeps_nobody_out(tmp_path, more):
    """Neither by the files that it leaves behind, nor by a child that lives on."""
    folder = tmp_path / "out"
    with held_elsewhere(folder, *more) as running:
        running.kill()
        running.wait()
        assert list(tmp_path.iterdir())
        with occupied(folder):
            pass
    assert not list(tmp_path.iterdir())


def test_a_folder_is_one_under_all_its_names(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    with occupied(tmp_path / "disk" / "out"), pytest.raises(InputError), occupied(tmp_path / "link" / "out"):
        pass


def test_nothing_stays_behind(tmp_path):
    """Not even folders above one that was never made; those that hold something then do stay."""
    with occupied(tmp_path / "a" / "b" / "out"):
        pass
    assert not list(tmp_path.iterdir())
    with occupied(tmp_path / "a" / "b" / "out"):
        (tmp_path / "a" / "b" / "out").mkdir()
    assert [path.name for path in (tmp_path / "a" / "b").iterdir()] == ["out"]


def test_a_damaged_note_is_no_trouble(tmp_path):
    folder = tmp_path / "out"
    with occupied(folder):
        (note,) = tmp_path.iterdir()
        for content, told in ((b"\xff\x00\x1b[2J" * 1000, r"\ufffd"), (b"", "another process")):
            note.write_bytes(content)
            with pytest.raises(InputError, match=rf"found {told}") as caught, occupied(folder):
                pass
            assert str(caught.value).isprintable() and len(str(caught.value)) < 500


def test_a_disk_of_its_own_is_marked_within(tmp_path, monkeypatch):
    """Nothing can be written beside it, as where a disk is mounted at a user's folder in the root's."""
    disk = tmp_path / "disk"
    disk.mkdir()
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path)
    with occupied(disk):
        assert len(list(disk.iterdir())) == 1
        with pytest.raises(InputError), occupied(disk):
            pass
    assert list(tmp_path.iterdir()) == [disk] and not list(disk.iterdir())


@pytest.mark.skipif(os.name == "nt", reason="flock is of Unix")
@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP])
def test_a_disk_without_locks_is_used_with_a_warning(tmp_path, monkeypatch, caplog, number):
    """Some network disks have none; nobody is kept from their work by that."""

    def flock(descriptor, operation):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", flock)
    file_locks._warn.cache_clear()
    out = tmp_path / "out"
    with occupied(out), atomic.new_folder(out, "mark") as folder, atomic.new_file(folder / "mark") as file:
        file.write_text("")
    assert (tmp_path / "out" / "mark").is_file()
    shutil.rmtree(tmp_path / "out")
    assert "this disk has no locks" in caplog.text
    assert not list(tmp_path.iterdir())
