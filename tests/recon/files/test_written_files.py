"""Of a folder that is written again, only files that sonotwin wrote there are replaced, and only as it wrote them."""

import hashlib
import os
from pathlib import Path

import pytest

from recon.errors import InputError
from recon.files import atomic, written_files
from recon.files.written_files import LIST, Addition


def make(out: Path, text: str = "first", by: str = "segment", **more: str) -> None:
    """A result of two files, one in a folder."""
    with atomic.new_folder(out, by) as folder:
        (folder / "slicer").mkdir()
        for name in ("metrics.json", "slicer/mass0.ply"):
            (folder / name).write_text(text)
        (folder / "overlays").mkdir()
        for name, content in more.items():
            (folder / name).write_text(content)


def everything(root: Path) -> dict[str, str]:
    """Digest, or target, of all that is in a folder, but lists of sonotwin's."""
    found = {}
    for place, folders, files in os.walk(root):
        for name in (*files, *(name for name in folders if os.path.islink(os.path.join(place, name)))):
            path = Path(place, name)
            content = os.readlink(path).encode() if path.is_symlink() else path.read_bytes()
            found[path.relative_to(root).as_posix()] = hashlib.sha256(content).hexdigest()
        found |= {Path(place, name).relative_to(root).as_posix() + "/": "" for name in folders}
    return {name: digest for name, digest in found.items() if not name.endswith(LIST)}


def write(path: Path, text: str = "years of work") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def linked(path: Path, target: Path) -> None:
    target.mkdir() if not target.suffix else write(target)
    path.symlink_to(target)


def entered(out: Path, name: str, by: str) -> None:
    with atomic.listed_file(out, name, by) as file:
        write(file)


KEPT = {
    "beside": lambda out: write(out / "thesis.txt"),
    "hidden": lambda out: write(out / ".notes"),
    "below ours": lambda out: write(out / "slicer" / "thesis.txt"),
    "in a folder of its own": lambda out: write(out / "thesis" / "chapters" / "1.txt"),
    "an empty folder": lambda out: (out / "thesis").mkdir(),
    "a link to a file": lambda out: linked(out / "link", out.parent / "thesis.txt"),
    "a link to a folder": lambda out: linked(out / "link", out.parent / "thesis"),
    "a link to nothing": lambda out: (out / "link").symlink_to("nowhere"),
    "another result": lambda out: make(out / "evaluation", "its", "evaluate"),
    "a pipe's name, beside out": lambda out: write(out.parent / ".out.notes.new"),
    "the same bytes under a name of ours": lambda out: write(out / "extra", "extra"),
}


@pytest.mark.parametrize("place", KEPT)
def test_what_others_put_into_a_result_stays(tmp_path, place):
    """The same files with the same links, at the same places; ours are new, and those that aren't written any more are gone."""
    make(tmp_path / "out", mass1="of the first run alone")
    before = set(everything(tmp_path))
    KEPT[place](tmp_path / "out")
    theirs = {name: digest for name, digest in everything(tmp_path).items() if name not in before}
    for text in ("second", "third"):
        make(tmp_path / "out", text, extra="extra")
        after = everything(tmp_path)
        assert theirs.items() <= after.items() and (tmp_path / "out" / "slicer" / "mass0.ply").read_text() == text
        assert after.keys() - theirs.keys() == before - {"out/mass1"} | ({"out/extra"} - theirs.keys())


def moved(out: Path, name: str) -> None:
    """Move a file or folder of a result away, and link to it."""
    make(out)
    (out / name).rename(out.parent / "moved")
    (out / name).symlink_to(out.parent / "moved")


REFUSED = {
    "a stranger's figures": (lambda out: (write(out / "metrics.json"), write(out / "thesis.txt")), "no list of ours"),
    "another verb's result": (lambda out: make(out, by="surface"), "found one of surface"),
    "a file changed by hand": (lambda out: (make(out), write(out / "metrics.json", "frist")), "metrics.json: .*changed since"),
    "a file moved away and linked": (lambda out: moved(out, "metrics.json"), "metrics.json: .*changed since"),
    "a folder moved away and linked": (lambda out: moved(out, "slicer"), "slicer: expected a folder"),
    "an empty folder replaced by a link": (lambda out: moved(out, "overlays"), "overlays: .*found another file"),
    "a file where a new one is written": (lambda out: (make(out), write(out / "extra")), "extra: .*found another"),
    "a folder where a file is written": (lambda out: (make(out), write(out / "extra" / "a.txt")), "a.txt: .*found something"),
    "a damaged list": (lambda out: (make(out), write(out / LIST, "{}")), "damaged"),
    "a linked list": (lambda out: moved(out, LIST), "a link"),
}


@pytest.mark.parametrize("place", REFUSED)
def test_what_would_be_lost_is_refused(tmp_path, place):
    """By one line that names it, and the way on; all is as it was."""
    lay, expected = REFUSED[place]
    lay(tmp_path / "out")
    before = everything(tmp_path)
    with pytest.raises(InputError, match=expected) as said:
        make(tmp_path / "out", "second", extra="new")
    assert "another place" in str(said.value) and "\n" not in str(said.value)
    assert everything(tmp_path) == before


def test_what_comes_while_a_result_is_replaced_is_moved_over(tmp_path, monkeypatch):
    """Saved into the old folder after all was looked through: it is found in the new one."""
    make(tmp_path / "out")
    complete = written_files.complete

    def then_saved(new, old, *others):
        complete(new, old, *others)
        write(old / "late" / "thesis.txt")

    monkeypatch.setattr(written_files, "complete", then_saved)
    make(tmp_path / "out", "second")
    assert (tmp_path / "out" / "late" / "thesis.txt").read_text() == "years of work"
    assert sorted(os.listdir(tmp_path)) == ["out"]


def without_links(monkeypatch):
    """A file system that has no links, or lets nobody link to files of others."""

    def refuse(*_, **__):
        raise OSError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)


def test_files_without_second_names_are_moved_over(tmp_path, monkeypatch):
    make(tmp_path / "out")
    write(tmp_path / "out" / "thesis.txt")
    without_links(monkeypatch)
    make(tmp_path / "out", "second")
    assert (tmp_path / "out" / "thesis.txt").read_text() == "years of work" and sorted(os.listdir(tmp_path)) == ["out"]


@pytest.mark.parametrize("copied", [False, True])
def test_of_two_writers_without_links_both_keep_their_files(tmp_path, monkeypatch, copied):
    """Also where the second laid copies of the first's files into the new folder."""
    make(tmp_path / "out", manifest="of the first")
    before = everything(tmp_path / "out")
    without_links(monkeypatch)
    with atomic.new_folder(tmp_path / "out", "sweep", Addition(("manifest",), "sweep")) as folder:
        if copied:
            atomic.link_tree(tmp_path / "out", folder, leave_out={"manifest"})
        write(folder / "manifest", "of both")
        write(folder / "sweep" / "0000.png")
    after = everything(tmp_path / "out")
    assert after.keys() == before.keys() | {"sweep/", "sweep/0000.png"} and sorted(os.listdir(tmp_path)) == ["out"]
    assert {name for name in before if before[name] != after[name]} == {"manifest"}
    assert {one.by for each in (written_files.read_list(tmp_path / "out") or {}).values() for one in each} >= {"segment", "sweep"}


def add(out: Path, by: str = "twin") -> None:
    with atomic.new_folder(out, by, Addition(("manifest",), "sweep")) as folder:
        write(folder / "manifest", by)
        write(folder / "sweep" / "0000.png", "first")


PARTS = {
    "new": (lambda out: None, None),
    "notes beside": (lambda out: (add(out), write(out / "sweep" / "notes.txt")), None),
    "own": (add, None),
    "a result within": (lambda out: make(out / "sweep" / "take01", by="record"), None),
    "changed": (lambda out: (add(out), write(out / "sweep" / "0000.png", "new")), "0000.png: .*changed since"),
    "another's": (lambda out: add(out, "record"), "0000.png: .*found that of record"),
    "of nobody": (lambda out: write(out / "sweep" / "0000.png"), "0000.png: .*found another file"),
    "changed elsewhere": (lambda out: write(out / "metrics.json", "by hand"), None),
}


@pytest.mark.parametrize("place", PARTS)
def test_a_part_that_may_not_be_replaced_is_refused_before_the_work(tmp_path, place):
    """What passes the check can be added in the end; the other parts stay as they are."""
    lay, expected = PARTS[place]
    make(tmp_path / "out", manifest="of the first")
    lay(tmp_path / "out")
    before = everything(tmp_path)
    if expected is None:
        atomic.check_folder(tmp_path / "out", "twin", adds=Addition(("manifest",), "sweep"))
        add(tmp_path / "out")
        changed = {name for name, digest in before.items() if everything(tmp_path)[name] != digest}
        assert changed <= {"out/manifest"}
        return
    with pytest.raises(InputError, match=expected):
        atomic.check_folder(tmp_path / "out", "twin", adds=Addition(("manifest",), "sweep"))
    assert everything(tmp_path) == before


@pytest.mark.parametrize(
    ("lay", "expected"),
    [
        (lambda out: write(out / "log.txt", "frist"), "log.txt: .*changed since"),
        (lambda out: write(out / "other.txt"), "other.txt: .*another file"),
        (lambda out: linked(out / "other.txt", out.parent / "thesis.txt"), "other.txt: .*another file"),
        (lambda out: entered(out, "other.txt", "demo"), "other.txt: .*that of demo"),
    ],
    ids=["changed", "another", "a link", "another writer's"],
)
def test_a_folder_that_is_filled_keeps_what_others_put_there(tmp_path, lay, expected):
    """One that grows may be appended to; killed before the first file, or between list and file, the next run goes on."""
    out = tmp_path / "out"
    atomic.check_filled_folder(out, "train")
    atomic.begin_filled(out, "train")
    (out / ".log.4194305.new.txt").touch()  # of a process that was killed
    atomic.check_filled_folder(out, "train")
    atomic.remove_leftovers(out / "log.txt")
    for text in ("first", "first and last"):
        with atomic.listed_file(out, "log.txt", "train", grows=True) as file:
            file.write_text(text)
    with pytest.raises(KeyboardInterrupt), atomic.listed_file(out, "log.txt", "train") as file:
        file.write_text("never")
        raise KeyboardInterrupt
    with (out / "log.txt").open("a") as log:
        log.write(", and more")
    atomic.check_filled_folder(out, "train")
    lay(out)
    before = everything(tmp_path)
    with pytest.raises(InputError, match=expected):
        for name in ("log.txt", "other.txt"):
            atomic.check_listed(out, name, "train")
    with pytest.raises(InputError, match=expected):
        atomic.remove_listed(out, ["log.txt", "other.txt"], "train")
    assert everything(tmp_path) == before


def test_only_listed_files_are_discarded(tmp_path):
    """Of a list from a stranger too, which names files elsewhere; results of another writer stay."""
    make(tmp_path / "out")
    make(tmp_path / "out" / "its", by="evaluate")
    make(tmp_path / "out" / "pose")
    write(tmp_path / "out" / "pose" / "thesis.txt")
    write(tmp_path / "victim.txt")
    made = written_files.written(tmp_path / "victim.txt", "segment")
    written_files.write_list(tmp_path / "out" / LIST, {"../victim.txt": (made,), str(tmp_path / "victim.txt"): (made,)})
    written_files.discard(tmp_path / "out", "segment")
    assert {name for name in everything(tmp_path) if not name.endswith("/")} == {
        "victim.txt", "out/pose/thesis.txt", "out/metrics.json", "out/slicer/mass0.ply", "out/its/metrics.json",
        "out/its/slicer/mass0.ply",
    }  # fmt: skip
