"""A digest of code changes with any file of it, and with nothing else."""

import shutil
from pathlib import Path

import pytest

from recon.files.code_digest import code_digest

FILES = {
    "__init__.py": "",
    "phase.py": "PI = 3\n",
    "conf/rig.yaml": "gamma: 2.2\n",
    "notes.md": "none\n",
    "deep/er/b.py": "x = 1\n",
}


def package(folder: Path, **changes: str | None) -> Path:
    """A folder `made` of files, with changes to them by their names; None leaves one out."""
    root = folder / "made"
    shutil.rmtree(root, ignore_errors=True)
    for name, content in (FILES | changes).items():
        if content is not None:
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_text(content)
    return root


def digest(folder: Path) -> str:
    code_digest.cache_clear()
    return code_digest(folder)


@pytest.mark.parametrize(
    "changes",
    [
        {"phase.py": "PI = 4\n"},
        {"conf/rig.yaml": "gamma: 2.3\n"},
        {"deep/er/b.py": None},
        {"new.py": ""},
        {"deep/er/b.py": None, "deep/b.py": "x = 1\n"},
        {"__init__.py": "PI = 3\n", "phase.py": ""},
        {"notes.md": "some\n"},
        {"weights/net.onnx": "0 1\n"},
    ],
    ids=["code", "settings", "one less", "one more", "moved", "exchanged", "words", "network"],
)
def test_other_code_has_another_digest(tmp_path, changes):
    before = digest(package(tmp_path))
    assert digest(package(tmp_path, **changes)) != before
    assert digest(package(tmp_path)) == before


def test_compiled_code_leftovers_and_places_do_not_count(tmp_path):
    """What Python and Numba keep in __pycache__, what editors and `sed` write beside, and the folder that a package lies in."""
    before = digest(package(tmp_path))
    for names in (
        ("__pycache__/phase.pyc", "deep/er/__pycache__/b.nbi"),
        (".phase.py.swp", "phase.py~", "sedAbC123", ".cache/a.py"),
    ):
        assert digest(package(tmp_path, **dict.fromkeys(names, "x"))) == before
    assert digest(package(tmp_path / "elsewhere")) == before
    assert len(before) == 12 and int(before, 16) >= 0


def test_packages_are_found_by_their_names():
    """As by their folders; each of several counts, in their order."""
    code_digest.cache_clear()
    files = Path(code_digest.__wrapped__.__code__.co_filename).parent
    assert code_digest("recon.files") == code_digest(files)
    assert len({code_digest("recon.files"), code_digest("recon.model"), code_digest("recon.files", "recon.model")}) == 3
    assert code_digest("recon.model", "recon.files") != code_digest("recon.files", "recon.model")


def test_a_package_that_is_not_there_is_named():
    with pytest.raises(ModuleNotFoundError, match="expected the package nowhere_at_all, found none"):
        code_digest("nowhere_at_all")
