"""What is written appears whole; what was there is replaced only if it is of the same kind, and never what is read."""

import itertools
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from recon.errors import InputError
from recon.files import atomic
from recon.files.written_files import LIST


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    with atomic.new_file(tmp_path / "a.txt") as temporary:
        assert temporary.suffix == ".txt"
        temporary.write_text("first")
        assert not (tmp_path / "a.txt").exists()
    with pytest.raises(KeyboardInterrupt), atomic.new_file(tmp_path / "a.txt") as temporary:
        temporary.write_text("sec")
        raise KeyboardInterrupt
    assert (tmp_path / "a.txt").read_text() == "first" and names(tmp_path) == ["a.txt"]


def test_a_folder_appears_whole_or_not_at_all(tmp_path):
    for text in ("first", "second"):
        with atomic.new_folder(tmp_path / "out", "mark") as folder:
            (folder / "mark").write_text(text)
    with pytest.raises(KeyboardInterrupt), atomic.new_folder(tmp_path / "out", "mark") as folder:
        (folder / "mark").write_text("third")
        raise KeyboardInterrupt
    assert (tmp_path / "out" / "mark").read_text() == "second" and names(tmp_path) == ["out"]


def test_a_folder_of_another_kind_is_left_alone(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="found other files"), atomic.new_folder(tmp_path / "out", "mark"):
        pass
    assert names(tmp_path / "out") == ["thesis.tex"]


@pytest.mark.parametrize("source", ["out", "out/inner/file", "link"])
def test_what_is_read_is_never_replaced(tmp_path, source):
    """Not if it is the folder itself, lies in it, or is the same folder by another name."""
    with atomic.new_folder(tmp_path / "out", "mark") as folder:
        (folder / "inner").mkdir()
        (folder / "inner" / "file").write_text("")
    (tmp_path / "link").symlink_to("out")
    atomic.check_folder(tmp_path / "out", "mark", inputs=[tmp_path, tmp_path / "outer"])
    with pytest.raises(InputError, match="expected a folder apart from what is read"):
        atomic.check_folder(tmp_path / "out", "mark", inputs=[tmp_path / source])


@pytest.mark.parametrize("name", ["a.txt", "folder"])
def test_what_a_killed_run_has_left_is_found(tmp_path, name):
    """The temporary as a kill would leave it goes; hidden files and folders that are merely alike stay."""
    path = tmp_path / name
    with atomic.new_file(path) as temporary:
        temporary.write_text("")
    others = {
        ".a.txt",
        ".a.2024.txt",
        ".a.notes.new.txt",
        ".b.4194305.new.txt",
        ".folder",
        ".folder.2024",
        ".folders.4194305.new",
    }
    for other in others:
        (tmp_path / other).write_text("")
    left = tmp_path / temporary.name.replace(str(os.getpid()), "4194305")  # above the largest process number
    left.mkdir()
    (left / "half").write_text("")
    path.unlink()
    atomic.remove_leftovers(path)
    assert set(names(tmp_path)) == others


def test_the_folder_set_aside_is_found_too(tmp_path):
    (tmp_path / ".out.4194305.old").mkdir()
    atomic.remove_leftovers(tmp_path / "out")
    assert names(tmp_path) == []


def test_what_another_run_is_writing_is_left_alone(tmp_path):
    """A temporary of a process that is still writing is no leftover."""
    with atomic.new_folder(tmp_path / "folder", "mark") as temporary:
        assert program(tmp_path, 'atomic.remove_leftovers(Path("folder")); atomic.restore([Path("folder")])').wait() == 0
        assert temporary.is_dir()
        (temporary / "mark").write_text("")
    assert names(tmp_path) == ["folder"]


@pytest.mark.parametrize("process", [os.getpid, os.getppid], ids=["own", "parent"])
def test_a_killed_process_may_have_had_the_number_of_a_living_one(tmp_path, process):
    """As in containers, where every run has the same: its leftovers neither stand in the way nor hold back what was set aside."""
    number = process()
    write_both(tmp_path, "first")
    (tmp_path / "capture").rename(tmp_path / f".capture.{number}.old")
    for name in ("capture", "truth"):
        (tmp_path / f".{name}.{number}.new").mkdir()
        (tmp_path / f".{name}.{number}.new" / "half").write_text("")
    atomic.restore([tmp_path / "truth", tmp_path / "capture"])
    assert names(tmp_path) == ["capture", "truth"] and (tmp_path / "capture" / "mark").read_text() == "first"
    (tmp_path / f".capture.{number}.new").mkdir()
    (tmp_path / f".capture.{number}.new" / "half").write_text("")
    write_both(tmp_path, "second")
    assert [sorted(path.name for path in (tmp_path / name).iterdir()) for name in names(tmp_path)] == [[LIST, "mark"]] * 2


@pytest.mark.parametrize("place", ["file", "folder"])
def test_one_process_writes_at_a_time(tmp_path, place):
    """A second one waits for the first, and says so; it sees what the first has written."""
    ours, theirs = {
        "file": (
            atomic.new_file(tmp_path / "out"),
            'new_file(Path("out")) as new: new.write_text(Path("out").read_text() + "2")',
        ),
        "folder": (
            atomic.new_folder(tmp_path / "out", "mark"),
            'new_folder(Path("out"), "mark") as new: (new / "mark").write_text(Path("out/mark").read_text() + "2")',
        ),
    }[place]
    with ours as temporary:
        other = program(tmp_path, f"file_locks.PATIENCE_S = 0.0\nwith atomic.{theirs}")
        said = other.stderr.readline()
        assert re.search(rf"out: waiting for process {os.getpid()} on .+ since 20.+ UTC, which is writing it", said)
        (temporary / "mark" if place == "folder" else temporary).write_text("1")
    assert other.wait() == 0 and other.stderr.read() == ""
    assert (tmp_path / "out" / "mark" if place == "folder" else tmp_path / "out").read_text() == "12"
    assert names(tmp_path) == ["out"]


def test_a_folder_is_judged_once_it_stands_still(tmp_path):
    """While another process exchanges it, a folder may lack its marker for a moment."""
    with atomic.new_folder(tmp_path / "out", "mark") as temporary:
        (temporary / "mark").write_text("1")
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "half").write_text("")
        lines = 'file_locks.PATIENCE_S = 0.0\nwith atomic.new_folder(Path("out"), "mark") as new: (new / "mark").write_text("2")'
        other = program(tmp_path, lines)
        assert "waiting" in other.stderr.readline()
    assert other.wait() == 0 and (tmp_path / "out" / "mark").read_text() == "2"


def program(folder: Path, text: str) -> subprocess.Popen:
    """Another process, that runs some lines in a folder."""
    text = f"from pathlib import Path\nfrom recon import file_locks\nfrom recon.files import atomic\n{text}"
    env = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[3])}
    return subprocess.Popen([sys.executable, "-c", text], cwd=folder, env=env, stderr=subprocess.PIPE, text=True)


def write_both(root: Path, text: str) -> None:
    with atomic.new_folders({root / "truth": "mark", root / "capture": "mark"}) as folders:
        for folder in folders:
            (folder / "mark").write_text(text)


@pytest.mark.parametrize("done", [False, True], ids=["before", "after"])
@pytest.mark.parametrize("calls", range(3))
def test_an_error_while_folders_change_places_leaves_both_of_one_age(tmp_path, monkeypatch, calls, done):
    """Before or after any of the renamings: the old ones, or the new ones once the last is in its place, and nothing else."""
    write_both(tmp_path, "first")
    count, rename, swap = itertools.count(), Path.rename, atomic.swap

    def or_raise(work):
        def worked(*given):
            strikes = next(count) == calls
            if strikes and not done:
                raise OSError(5, "Input/output error")
            result = work(*given)
            if strikes:
                raise OSError(5, "Input/output error")
            return result

        return worked

    monkeypatch.setattr(Path, "rename", or_raise(rename))
    monkeypatch.setattr(atomic, "swap", or_raise(swap))
    with pytest.raises(OSError, match="Input/output error"):
        write_both(tmp_path, "second")
    assert names(tmp_path) == ["capture", "truth"]
    age = "first" if calls + done < 2 else "second"
    assert [sorted(path.name for path in (tmp_path / name).iterdir()) for name in names(tmp_path)] == [[LIST, "mark"]] * 2
    assert [(tmp_path / name / "mark").read_text() for name in names(tmp_path)] == [age, age]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_folders_change_places_waits(tmp_path, monkeypatch, number):
    """It comes when all are in place: an exchange is never left half done, nor is the cleaning up."""
    write_both(tmp_path, "first")
    rename, heard = Path.rename, []

    def struck(self, target):
        os.kill(os.getpid(), number)
        result = rename(self, target)
        assert heard == []
        return result

    def hear(number, frame):
        heard.append(number)
        raise KeyboardInterrupt

    before = signal.signal(number, hear)
    monkeypatch.setattr(Path, "rename", struck)
    try:
        with pytest.raises(KeyboardInterrupt):
            write_both(tmp_path, "second")
    finally:
        signal.signal(number, before)
    assert names(tmp_path) == ["capture", "truth"] and heard == [number]
    assert [(tmp_path / name / "mark").read_text() for name in names(tmp_path)] == ["second", "second"]


def test_folders_appear_together_or_not_at_all(tmp_path):
    write_both(tmp_path, "first")
    places = dict.fromkeys((tmp_path / "truth", tmp_path / "other"), "mark")
    with pytest.raises(KeyboardInterrupt), atomic.new_folders(places) as (_, other):
        (other / "mark").write_text("second")
        raise KeyboardInterrupt
    assert names(tmp_path) == ["capture", "truth"] and (tmp_path / "truth" / "mark").read_text() == "first"


@pytest.mark.parametrize("error", [InputError, KeyboardInterrupt])
def test_folders_made_for_those_that_failed_go_away(tmp_path, error):
    """But not what stood there, nor what others have put beside them meanwhile."""
    (tmp_path / "mine").mkdir()
    for outer, inner in (("mine", "a"), ("new", "b"), ("shared", "c")):
        places = dict.fromkeys((tmp_path / outer / inner / name for name in ("truth", "capture")), "mark")
        with pytest.raises(error), atomic.new_folders(places):
            if outer == "shared":
                (tmp_path / outer / "notes.txt").write_text("another's")
            raise error("refused")
    assert names(tmp_path) == ["mine", "shared"]
    assert names(tmp_path / "mine") == [] and names(tmp_path / "shared") == ["notes.txt"]


def test_folders_that_a_failed_run_removes_are_not_left_by_one_that_waited_for_it(tmp_path):
    """The second one's lock has made them again, or was there before the first one could remove them."""
    (tmp_path / "mine").mkdir()
    for outer in ("mine", "new"):
        place = f"{outer}/a/b/capture"
        with pytest.raises(KeyboardInterrupt), atomic.new_folder(tmp_path / place, "mark"):
            other = program(
                tmp_path, f'file_locks.PATIENCE_S = 0.0\nwith atomic.new_folder(Path("{place}"), "mark"): raise SystemExit(7)'
            )
            assert "waiting" in other.stderr.readline()
            raise KeyboardInterrupt
        assert other.wait() == 7 and other.stderr.read() == ""
    assert names(tmp_path) == ["mine"] and names(tmp_path / "mine") == []


def test_one_that_waited_removes_what_the_first_one_could_not(tmp_path, monkeypatch):
    """It has its lock in there when the first one clears up, and fails later."""
    remove, others = Path.rmdir, []

    def late(folder):
        while "held" not in others[0].stderr.readline():
            pass
        monkeypatch.setattr(Path, "rmdir", remove)
        remove(folder)

    lines = ["file_locks.PATIENCE_S = 0.0", 'with atomic.new_folder(Path("new/a/capture"), "mark"):']
    lines += ['    print("held", file=__import__("sys").stderr, flush=True)', '    while not Path("go").exists(): pass']
    with pytest.raises(KeyboardInterrupt), atomic.new_folder(tmp_path / "new/a/capture", "mark"):
        others.append(program(tmp_path, "\n".join([*lines, "    raise SystemExit(7)"])))
        assert "waiting" in others[0].stderr.readline()
        monkeypatch.setattr(Path, "rmdir", late)
        raise KeyboardInterrupt
    assert names(tmp_path) == ["new"]
    (tmp_path / "go").touch()
    assert others[0].wait() == 7 and names(tmp_path) == ["go"]


def test_a_place_that_another_run_removes_meanwhile_can_be_written(tmp_path, monkeypatch):
    """It had made the folder, and fails just before it is tried; a place that is there but takes nothing is still refused."""
    (tmp_path / "new").mkdir()
    made = atomic.TemporaryDirectory

    def once_removed(prefix, dir):
        if Path(dir).name == "new" and not names(Path(dir)):
            Path(dir).rmdir()
        return made(prefix=prefix, dir=dir)

    def refusing(prefix, dir):
        raise FileNotFoundError(2, "No such file or directory")  # as /proc says

    monkeypatch.setattr(atomic, "TemporaryDirectory", once_removed)
    with atomic.new_folder(tmp_path / "new" / "out", "mark"):
        pass
    assert (tmp_path / "new" / "out").is_dir()
    monkeypatch.setattr(atomic, "TemporaryDirectory", refusing)
    with pytest.raises(InputError, match="not writable"):
        atomic.check_folder(tmp_path / "other", "mark")


def test_a_lock_alone_is_a_leftover(tmp_path):
    """Of a process that was killed before it made anything else."""
    for name in ("truth", "capture"):
        (tmp_path / f".{name}.lock").write_text("")
        atomic.restore([tmp_path / "truth", tmp_path / "capture"])
        assert names(tmp_path) == []


@pytest.mark.parametrize("atomically", [True, False])
@pytest.mark.parametrize("calls", range(6))
def test_a_killed_process_leaves_old_folders_or_new_ones(tmp_path, calls, atomically):
    """Killed before any of the renamings: the next process finds a pair of one age, new if all was exchanged, and no more."""
    write_both(tmp_path, "first")
    program = f"""
import itertools, os
from pathlib import Path
from recon.files import atomic
from recon.files.written_files import LIST
count, rename, swap = itertools.count(), Path.rename, atomic.swap
def or_die(work):
    return lambda *given: os._exit(9) if next(count) == {calls} else work(*given)
Path.rename = or_die(rename)
atomic.swap = or_die(swap) if {atomically} else lambda *given: False
with atomic.new_folders({{Path("truth"): "mark", Path("capture"): "mark"}}) as folders:
    for folder in folders:
        (folder / "mark").write_text("second")
"""
    root = {"PYTHONPATH": str(Path(__file__).resolve().parents[3])}
    status = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, env=os.environ | root, check=False).returncode
    assert status == (9 if calls < (3 if atomically else 5) else 0)
    if atomically:
        assert (tmp_path / "capture" / "mark").is_file()
    marks = [tmp_path / name / "mark" for name in ("capture", "truth")]
    there = [mark.read_text() for mark in marks if mark.is_file()]
    assert len(set(there)) <= 1  # never does one stand beside another age of the other
    atomic.restore([tmp_path / "truth", tmp_path / "capture"])
    age = "first" if calls < (2 if atomically else 3) else "second"
    assert [(tmp_path / name / "mark").read_text() for name in names(tmp_path)] == [age, age]


@pytest.mark.skipif(sys.platform != "linux", reason="the system can't exchange folders")
def test_a_folder_is_there_at_every_moment(tmp_path):
    """While it is replaced over and over, another process always finds it whole."""
    with atomic.new_folder(tmp_path / "out", "mark") as folder:
        (folder / "mark").write_text("")
    lines = """
import itertools
for number in itertools.count():
    with atomic.new_folder(Path("out"), "mark") as new: (new / "mark").write_text(str(number))
"""
    other = program(tmp_path, lines)
    seen = set()
    while len(seen) < 30:
        seen.add((tmp_path / "out" / "mark").read_text())
        assert other.poll() is None
    other.kill()
    other.wait()


@pytest.mark.parametrize("target", ["there", "new"])
def test_links_are_written_through(tmp_path, target):
    """What a link leads to is replaced, again and again; the link stays, and nothing is left beside it."""
    (tmp_path / "disk").mkdir()
    if target == "there":
        (tmp_path / "disk" / "folder").mkdir()
        (tmp_path / "disk" / "file").write_text("")
    for name in ("folder", "file"):
        (tmp_path / name).symlink_to(Path("disk", name))
    for text in ("first", "second"):
        with atomic.new_folder(tmp_path / "folder", "mark") as folder, atomic.new_file(tmp_path / "file") as file:
            (folder / "mark").write_text(text)
            file.write_text(text)
        assert (tmp_path / "folder").is_symlink() and (tmp_path / "file").is_symlink()
        assert (tmp_path / "disk" / "folder" / "mark").read_text() == (tmp_path / "disk" / "file").read_text() == text
    assert names(tmp_path) == ["disk", "file", "folder"] and names(tmp_path / "disk") == ["file", "folder"]


def test_a_loop_of_links_is_refused(tmp_path):
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(InputError, match="loop of links"):
        atomic.check_folder(tmp_path / "a", "mark", inputs=[tmp_path / "b"])


def test_a_folder_that_is_filled_needs_no_writable_parent(tmp_path, monkeypatch):
    """As a disk that is mounted in the root's folder: it can be filled, but not replaced, nor can one be made beside it."""
    made = atomic.TemporaryDirectory
    (disk := tmp_path / "disk").mkdir()

    def refusing(prefix, dir):
        if Path(dir) == tmp_path:
            raise PermissionError(13, "Permission denied")
        return made(prefix=prefix, dir=dir)

    monkeypatch.setattr(atomic, "TemporaryDirectory", refusing)
    atomic.check_filled_folder(disk, "mark")
    for check, path in ((atomic.check_folder, disk), (atomic.check_filled_folder, tmp_path / "other")):
        with pytest.raises(InputError, match=rf"{path.name}: expected a place to write to, found {tmp_path} not writable"):
            check(path, "mark")
    (disk / "thesis.tex").touch()
    with pytest.raises(InputError, match="found other files"):
        atomic.check_filled_folder(disk, "mark")
    assert names(disk) == ["thesis.tex"]


@pytest.mark.parametrize("place", [lambda path: atomic.new_file(path), lambda path: atomic.new_folder(path, "mark")])
def test_a_full_disk_is_named(tmp_path, place):
    with pytest.raises(OSError, match=r"No space left.*out"), place(tmp_path / "out"):
        raise OSError(28, "No space left on device")
    assert names(tmp_path) == []


def test_linked_files_outlive_the_folder_that_they_come_from(tmp_path):
    (tmp_path / "old" / "inner").mkdir(parents=True)
    for name in ("kept", "left", "inner/left"):
        (tmp_path / "old" / name).write_text(name)
    (tmp_path / "new").mkdir()
    atomic.link_tree(tmp_path / "old", tmp_path / "new", leave_out={"left"})
    assert names(tmp_path / "new") == ["inner", "kept"] and (tmp_path / "new" / "inner" / "left").read_text() == "inner/left"
    assert (tmp_path / "old" / "left").read_text() == "left"


def test_files_are_copied_where_there_are_no_links(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    (tmp_path / "new").mkdir()
    (tmp_path / "old" / "inner").mkdir(parents=True)
    (tmp_path / "old" / "inner" / "file").write_text("text")
    atomic.link_tree(tmp_path / "old", tmp_path / "new")
    assert (tmp_path / "new" / "inner" / "file").read_text() == "text"
