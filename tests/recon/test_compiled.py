"""What was compiled is loaded again wherever its sources lie, and never after one of them has changed."""

import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import numba
import pytest

from recon import compiled

KERNEL = """
from recon.compiled import njit
from recon.scales import FACTOR, described, doubled

@njit
def scaled(x):
    return FACTOR * doubled(x)

def plain():
    return described()
"""
SCALES = """
from recon.compiled import njit

FACTOR = 3

@njit(inline="always")
def doubled(x):
    return 2 * x

def described():
    return "by a factor"
"""
RUN = "import logging; logging.basicConfig(level=logging.INFO); from recon.kernel import scaled; print(scaled(7))"


LATE = """
from recon.kernel import scaled
load, calls = scaled._cache.load_overload, []
scaled._cache.load_overload = lambda *args: calls.append(args) or (load(*args) if len(calls) > 1 else None)
print(scaled(7))
"""


@pytest.fixture
def clone(tmp_path) -> Path:
    """A tree with a compiled function that takes a constant and another function from a second module."""
    return written(tmp_path / "clone")


def written(root: Path) -> Path:
    (root / "recon").mkdir(parents=True)
    shutil.copy(compiled.__file__, root / "recon")
    for name, text in (("__init__", ""), ("kernel", KERNEL), ("scales", SCALES)):
        (root / "recon" / f"{name}.py").write_text(text)
    return root


def edit(root: Path, old: str, new: str) -> None:
    path = root / "recon" / "scales.py"
    path.write_text(path.read_text().replace(old, new))


def run(root: Path, script: str = RUN) -> tuple[int, int]:
    """What the compiled function gives, and how many functions were compiled for it."""
    env = os.environ | {"SONOTWIN_CACHE": str(root.parent / "cache"), "PYTHONPATH": str(root)}
    done = subprocess.run([sys.executable, "-c", script], cwd=root, env=env, capture_output=True, text=True, check=True)
    return int(done.stdout), done.stderr.count("compiling")


def test_it_is_compiled_once_for_all_clones_and_anew_after_a_change_elsewhere(clone):
    first, count = run(clone)
    assert first == 42 and count >= 1
    assert run(clone) == (42, 0)
    assert run(written(clone.parent / "second")) == (42, 0)
    edit(clone, "FACTOR = 3", "FACTOR = 5")
    value, count = run(clone)
    assert value == 70 and count >= 1
    assert run(clone.parent / "second") == (42, 0)  # what was compiled from other sources is still there


def test_a_process_that_waited_for_another_loads_its_result(clone):
    """It finds nothing at first, and the other process's function once that is done."""
    run(clone)
    assert run(clone, LATE) == (42, 0)


@pytest.mark.parametrize(
    ("old", "new", "matters"),
    [("FACTOR = 3", "FACTOR = 4", True), ("2 * x", "x + x", True), ('"by a factor"', '"by some factor"', True)],
)
def test_the_hash_covers_what_compiled_functions_take(clone, old, new, matters):
    kernel = clone / "recon" / "kernel.py"
    before = compiled.source_hash(kernel, clone)
    edit(clone, old, new)
    assert (compiled.source_hash(kernel, clone) != before) == matters


def test_the_hash_leaves_out_what_plain_functions_take(clone):
    kernel = clone / "recon" / "kernel.py"
    (clone / "recon" / "words.py").write_text("WORD = 'a'\n")
    kernel.write_text("from recon.words import WORD\n" + kernel.read_text().replace("described()", "WORD"))
    before = compiled.source_hash(kernel, clone)
    (clone / "recon" / "words.py").write_text("WORD = 'b'\n")
    assert compiled.source_hash(kernel, clone) == before


def test_a_cache_that_cannot_be_written_is_no_fault(clone):
    (clone.parent / "cache").write_text("a file where the folder should be")
    assert run(clone)[0] == 42


@pytest.mark.parametrize("count", [0, 1, 3, 100])
@pytest.mark.parametrize("threads", [1, 2, 5])
def test_threads_share_a_range(monkeypatch, threads, count):
    """Each number once, in at most so many threads."""
    monkeypatch.setattr(numba, "get_num_threads", lambda: threads)
    done, names = [], set()

    def part(first, end):
        done.extend(range(first, end))
        names.add(threading.get_ident())

    compiled.in_threads(part, count)
    assert sorted(done) == list(range(count))
    assert len(names) <= threads


def test_a_mistake_in_a_thread_is_raised(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)
    with pytest.raises(ZeroDivisionError):
        compiled.in_threads(lambda first, end: 1 / (first - 1), 2)
