"""What was compiled is loaded again wherever its sources lie, and never after one of them has changed."""

import os
import shutil
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numba
import numpy as np
import pytest
from filelock import FileLock

from recon import compiled, user_cache

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


@pytest.fixture(scope="module")
def first_cache(tmp_path_factory) -> Path:
    """The cache that a first run has filled."""
    root = written(tmp_path_factory.mktemp("first") / "clone")
    first, count = run(root)
    assert first == 42 and count >= 1
    return root.parent / "cache"


@pytest.fixture
def clone(tmp_path) -> Path:
    """A tree with a compiled function that takes a constant and another function from a second module."""
    return written(tmp_path / "clone")


def written(root: Path) -> Path:
    (root / "recon").mkdir(parents=True)
    for name in ("compiled", "file_locks", "user_cache"):
        shutil.copy(Path(compiled.__file__).with_name(f"{name}.py"), root / "recon")
    for name, text in (("__init__", ""), ("kernel", KERNEL), ("scales", SCALES)):
        (root / "recon" / f"{name}.py").write_text(text)
    return root


def edit(root: Path, old: str, new: str) -> None:
    path = root / "recon" / "scales.py"
    path.write_text(path.read_text().replace(old, new))


def run(root: Path, script: str = RUN) -> tuple[int, int]:
    """What the compiled function gives, and how many functions were compiled for it."""
    env = os.environ | {"SONOTWIN_CACHE": str(root.parent / "cache"), "PYTHONPATH": str(root)}
    env |= {"PYTHONDONTWRITEBYTECODE": "1"}  # it counts as current for a source as long, edited in the second of its writing
    done = subprocess.run([sys.executable, "-c", script], cwd=root, env=env, capture_output=True, text=True, check=True)
    return int(done.stdout), done.stderr.count("compiling")


def test_it_is_compiled_once_for_all_clones_and_anew_after_a_change_elsewhere(clone, first_cache):
    shutil.copytree(first_cache, clone.parent / "cache")
    assert run(clone) == (42, 0)
    written(clone.parent / "second")
    edit(clone, "FACTOR = 3", "FACTOR = 5")
    value, count = run(clone)
    assert value == 70 and count >= 1
    assert run(clone.parent / "second") == (42, 0)  # what was compiled from other sources is still there


def test_a_process_that_waited_for_another_loads_its_result(clone, first_cache):
    """It finds nothing at first, and the other process's function once that is done."""
    shutil.copytree(first_cache, clone.parent / "cache")
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


def test_the_hash_covers_the_options_of_kernels(clone, monkeypatch):
    before = compiled.source_hash(clone / "recon" / "kernel.py", clone)
    monkeypatch.setitem(compiled.KERNEL, "error_model", "python")
    assert compiled.source_hash(clone / "recon" / "kernel.py", clone) != before


def test_a_kernel_divides_as_numpy_and_allocates_nothing():
    assert compiled.kernel(divided)(1.0, 0.0) == float("inf")
    with pytest.raises(numba.TypingError):
        compiled.kernel(filled)(3)


def divided(x, y):
    return x / y


def filled(n):
    return np.zeros(n)[0]


def test_the_hash_leaves_out_what_plain_functions_take(clone):
    kernel = clone / "recon" / "kernel.py"
    (clone / "recon" / "words.py").write_text("WORD = 'a'\n")
    kernel.write_text("from recon.words import WORD\n" + kernel.read_text().replace("described()", "WORD"))
    before = compiled.source_hash(kernel, clone)
    (clone / "recon" / "words.py").write_text("WORD = 'b'\n")
    assert compiled.source_hash(kernel, clone) == before


BINDINGS = {
    "a module": ("import recon.scales", "recon.scales.FACTOR * recon.scales.doubled(x)"),
    "a module by another name": ("import recon.scales as s", "s.FACTOR * s.doubled(x)"),
    "a module of a package": ("from recon import scales", "scales.FACTOR * scales.doubled(x)"),
    "a package": ("import recon", "recon.scales.FACTOR * recon.scales.doubled(x)"),
    "names of a package": ("from recon.units import FACTOR, twice", "FACTOR * twice(x)"),
    "a package with names of others": ("import recon.units as u", "u.FACTOR * u.twice(x)"),
    "a module with names of others": ("from recon.units.again import FACTOR, twice", "FACTOR * twice(x)"),
    "a function that is compiled here": ("from recon.units.slow import plain_scaled", "njit(plain_scaled)(x)"),
}


@pytest.mark.parametrize("binding", BINDINGS)
def test_the_hash_covers_what_is_imported_in_any_way(clone, binding):
    """And nothing besides: a module of the same package that is not used has no part in it."""
    package = clone / "recon" / "units"
    package.mkdir()
    (package / "__init__.py").write_text("from recon.scales import FACTOR, doubled as twice\nfrom recon.unused import UNUSED\n")
    (package / "again.py").write_text("from recon.units import FACTOR, twice\n")
    (package / "slow.py").write_text("from recon import scales\n\ndef plain_scaled(x):\n    return scales.FACTOR * x\n")
    (clone / "recon" / "unused.py").write_text("UNUSED = 1\n")
    line, formula = BINDINGS[binding]
    kernel = clone / "recon" / "kernel.py"
    kernel.write_text(f"from recon.compiled import njit\n{line}\n\n@njit\ndef scaled(x):\n    return {formula}\n")
    before = compiled.source_hash(kernel, clone)
    (clone / "recon" / "unused.py").write_text("UNUSED = 2\n")
    assert compiled.source_hash(kernel, clone) == before
    edit(clone, "FACTOR = 3", "FACTOR = 4")
    assert compiled.source_hash(kernel, clone) != before


def test_the_hash_leaves_out_what_is_installed_beside(clone):
    """In site-packages our packages lie among others, whose versions Numba doesn't follow either."""
    kernel, other = clone / "recon" / "kernel.py", clone / "other"
    other.mkdir()
    (other / "__init__.py").write_text("NUMBER = 1\n")
    kernel.write_text("import other\n" + kernel.read_text().replace("FACTOR *", "other.NUMBER *"))
    before = compiled.source_hash(kernel, clone)
    (other / "__init__.py").write_text("NUMBER = 2\n")
    assert compiled.source_hash(kernel, clone) == before


HELD = """
import logging
logging.basicConfig(level=logging.INFO)
from recon import file_locks
from recon.kernel import scaled
file_locks.PATIENCE_S = 0.1
print(scaled(7))
"""


def test_a_long_wait_for_another_process_is_told_once(clone, first_cache):
    shutil.copytree(first_cache, clone.parent / "cache")
    (place,) = (clone.parent / "cache" / "compiled" / "recon.kernel").iterdir()
    for path in place.glob("*.nb?"):
        path.unlink()
    env = os.environ | {"SONOTWIN_CACHE": str(clone.parent / "cache"), "PYTHONPATH": str(clone)}
    with FileLock(place / "scaled.lock"):
        other = subprocess.Popen([sys.executable, "-c", HELD], cwd=clone, env=env, stderr=subprocess.PIPE, text=True)
        assert other.stderr.readline() == "INFO:recon.compiled:waiting for another process that compiles recon.kernel.scaled\n"
    assert "waiting" not in other.communicate()[1] and other.returncode == 0


@pytest.mark.parametrize("name", ["_CacheLocator", "CacheImpl._locator_classes"])
def test_another_numba_is_refused_by_name(clone, name):
    """Without what is extended here nothing would be cached, or stale code be loaded."""
    script = f"from numba.core import caching; del caching.{name}; import recon.compiled"
    env = os.environ | {"PYTHONPATH": str(clone)}
    done = subprocess.run([sys.executable, "-c", script], cwd=clone, env=env, capture_output=True, text=True, check=False)
    complaint = f"ImportError: expected {compiled.NUMBA}, whose cache of compiled code this extends, found numba "
    last = done.stderr.splitlines()[-1]
    assert last.startswith(complaint) and last.endswith(f" without {name if '.' in name else f'numba.core.caching.{name}'}")


def test_the_range_of_versions_is_that_of_the_project():
    project = tomllib.loads((Path(compiled.__file__).parents[1] / "pyproject.toml").read_text())["project"]
    assert compiled.NUMBA in project["dependencies"]


def test_a_cache_that_cannot_be_written_is_no_fault(clone):
    (clone.parent / "cache").write_text("a file where the folder should be")
    assert run(clone)[0] == 42


def test_a_module_is_parsed_once_for_all_processes(tmp_path, monkeypatch):
    """Anew after a change, and where what is kept was cut short or can't be."""
    monkeypatch.setattr(compiled.user_cache, "compiled_code", lambda: tmp_path / "cache")
    read, module, parsed = compiled._read, tmp_path / "module.py", []
    monkeypatch.setattr(compiled, "_read", lambda source: parsed.append(source) or read(source))

    def look(source: bytes) -> set:
        module.write_bytes(source)
        return compiled._parsed.__wrapped__(module, 0).used

    one, other = b"from recon import threads\nA = threads.B", b"from recon import threads\nA = threads.C"
    assert [look(one), look(one), look(other), look(other)] == [{("threads", "B")}] * 2 + [{("threads", "C")}] * 2
    assert parsed == [one, other]
    (kept,) = (tmp_path / "cache" / "texts").iterdir()
    whole = kept.read_bytes()
    for damaged in (whole[:40], whole[:-40], whole[:-40] + bytes(40)):
        kept.write_bytes(damaged)
        parsed.clear()
        assert look(other) == {("threads", "C")} and parsed == [other] and kept.read_bytes() == whole
    kept.unlink()
    kept.parent.rmdir()
    kept.parent.write_text("a file in its place")
    assert look(other) == {("threads", "C")} and len(parsed) == 2


def test_what_is_long_unused_is_deleted(tmp_path):
    """Files and folders; what was used a day ago, and is now, stays for another month."""
    for name, days in {"new": 0, "used.txt": 29, "unused.txt": 31, "unused/code": 31}.items():
        place = tmp_path / name
        place.parent.mkdir(exist_ok=True)
        place.touch()
        os.utime(place.parent if "/" in name else place, (time.time() - days * 86400,) * 2)
    user_cache.note_use(tmp_path / "used.txt")
    user_cache.remove_unused(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"new", "used.txt"}
    assert time.time() - (tmp_path / "used.txt").stat().st_mtime < 86400
