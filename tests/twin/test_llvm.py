"""The choice of LLVM: by name where it is known, by trial where it isn't, and never one that ends the process."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from recon.errors import InputError
from twin import llvm


@pytest.fixture(autouse=True)
def clean(monkeypatch, tmp_path):
    """No settings of the caller's, and an empty cache."""
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.delenv("SONOTWIN_VARIANT", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def libraries(monkeypatch, tmp_path):
    """Make empty files of the given names the only libraries of the system."""

    def make(*names: str) -> list[Path]:
        folder = tmp_path / "lib"
        folder.mkdir()
        paths = [folder / name for name in names]
        for path in paths:
            path.touch()
        monkeypatch.setattr(llvm, "FOLDERS", (str(folder),))
        monkeypatch.setattr(llvm, "_linker_cache", list)
        return paths

    return make


def named(*parts: str) -> str:
    return "/".join(("", *parts))


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        (named("usr", "lib", "libLLVM-19.so.1"), 19),
        (named("usr", "lib", "libLLVM.so.19.1"), 19),
        (named("usr", "lib", "libLLVM-14.0.6.so.1"), 14),
        (named("usr", "lib", "llvm-15", "lib", "libLLVM.so"), 15),
        (named("opt", "homebrew", "opt", "llvm@19", "lib", "libLLVM.dylib"), 19),
        (named("opt", "homebrew", "Cellar", "llvm", "20.1.2", "lib", "libLLVM.dylib"), 20),
        (named("somewhere", "libLLVM.so"), None),
    ],
)
def test_version_is_read_from_names(path, expected):
    assert llvm.version(Path(path)) == expected


def test_version_is_read_through_a_link(tmp_path):
    (tmp_path / "libLLVM.so.18.1").touch()
    (tmp_path / "libLLVM.so").symlink_to("libLLVM.so.18.1")
    assert llvm.version(tmp_path / "libLLVM.so") == 18


def test_order_of_preference(libraries):
    """The known one, then newer, then 18 and 17, then those that DrJit fails with, then the nameless; links count once."""
    names = ["libLLVM-14.so.1", "libLLVM-17.so.1", "libLLVM.so.18.1", "libLLVM.so.19.1", "libLLVM.so.20.1", "libLLVM.so.21.1"]
    paths = libraries(*names)
    (paths[0].parent / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    assert [llvm.version(path) for path in llvm.candidates()] == [19, 20, 21, 18, 17, 14]


def test_known_versions_are_judged_without_trying(libraries, monkeypatch):
    good, *bad = libraries("libLLVM.so.19.1", "libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM-16.so.1")
    monkeypatch.setattr(llvm.subprocess, "run", lambda *_, **__: pytest.fail("a known version was tried"))
    assert [path for path in (good, *bad) if llvm.judge(path).works] == [good]
    assert llvm.find_llvm() == good


def test_without_llvm_the_package_is_named(libraries):
    libraries()
    with pytest.raises(InputError, match=r"found none; run .*llvm@?19"):
        llvm.find_llvm()


def test_with_only_a_bad_llvm_it_is_named_and_refused(libraries):
    (bad,) = libraries("libLLVM-15.so.1")
    with pytest.raises(InputError) as caught:
        llvm.prepare() if not llvm.nvidia_gpus() else llvm.find_llvm()
    assert str(bad) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "DRJIT_LIBLLVM_PATH" not in os.environ


def test_a_given_library_is_checked_too(libraries, monkeypatch):
    """A bad one isn't replaced silently by a good one of the system."""
    _, bad = libraries("libLLVM.so.19.1", "libLLVM-15.so.1")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(bad))
    with pytest.raises(InputError, match="unset DRJIT_LIBLLVM_PATH"):
        llvm.find_llvm()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(bad.parent / "libLLVM-19.so.7"))
    with pytest.raises(InputError, match="no such file"):
        llvm.find_llvm()


def test_an_unknown_version_is_tried_once(libraries, monkeypatch):
    """An empty file under an untested version's name fails its trial, and the verdict is read from the cache after that."""
    pytest.importorskip("drjit")
    (path,) = libraries("libLLVM.so.20.1")
    first = llvm.judge(path)
    assert not first.works
    assert str(path) in "".join(json.loads(llvm.cache_file().read_text()))
    monkeypatch.setattr(llvm.subprocess, "run", lambda *_, **__: pytest.fail("tried again"))
    assert llvm.judge(path) == first


def test_a_changed_library_is_tried_again(libraries):
    pytest.importorskip("drjit")
    (path,) = libraries("libLLVM.so.20.1")
    llvm.judge(path)
    os.utime(path, ns=(1, 1))
    assert llvm._remembered(path) is None


def test_a_broken_cache_is_an_empty_one(libraries):
    (path,) = libraries("libLLVM.so.20.1")
    llvm.cache_file().parent.mkdir(parents=True)
    llvm.cache_file().write_text("{")
    assert llvm._remembered(path) is None


def test_trial_agrees_with_what_is_known_by_version():
    """What the table of versions says of this system's libraries is what really happens; the trial survives an abort."""
    pytest.importorskip("drjit")
    paths = llvm.candidates()
    if not paths:
        pytest.skip("no LLVM on this system")
    for path in paths:
        assert llvm._try(path).works == llvm.judge(path).works, path


def test_variant_can_be_chosen_and_is_checked(monkeypatch):
    monkeypatch.setenv("SONOTWIN_VARIANT", "scalar_rgb")
    with pytest.raises(InputError, match="SONOTWIN_VARIANT: expected one of"):
        llvm.prepare()
    monkeypatch.setenv("SONOTWIN_VARIANT", "cuda_ad_mono")
    assert llvm.prepare() == "cuda_ad_mono"


def test_mitsuba_starts_and_computes():
    """In a process of its own, since a variant stays set."""
    pytest.importorskip("mitsuba")
    program = "from twin.llvm import load_mitsuba; mi = load_mitsuba(); print(mi.variant(), mi.Float([1, 2]) + 1)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split(maxsplit=1)[0] in llvm.VARIANTS
    assert done.stdout.strip().endswith("[2, 3]")
