"""Arrays come back from a file as they were, and damage is one line."""

import io
import re
import zipfile

import numpy as np
import pytest

from recon.errors import InputError
from recon.files import npz
from recon.files.npz import Form

FORMS = {"points": Form("f", (None, None, 3)), "lit": Form("b", (None, None))}


def values(**changes):
    return {"points": np.arange(24.0).reshape(2, 4, 3), "lit": np.ones((2, 4), bool), "other": np.arange(3)} | changes


def complaint(path):
    """The one line that is said of a file."""
    with pytest.raises(InputError) as caught:
        npz.read(path, FORMS)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)
    return str(caught.value).removeprefix(f"{path}: ")


def test_what_was_asked_for_comes_back(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", **values())
    found = npz.read(tmp_path / "a.npz", FORMS)
    assert found.keys() == FORMS.keys()
    assert all(np.array_equal(found[name], values()[name]) for name in FORMS)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"points": np.ones((2, 4))}, "points: expected an array of any x any x 3, found one of 2 x 4"),
        ({"points": np.ones((2, 4, 2))}, "points: expected an array of any x any x 3, found one of 2 x 4 x 2"),
        ({"points": np.ones((2, 4, 3), complex)}, "points: expected decimal numbers, found complex128"),
        ({"lit": np.ones((2, 4), int)}, "lit: expected true or false, found int64"),
    ],
)
def test_other_forms_are_refused(tmp_path, changes, expected):
    np.savez(tmp_path / "a.npz", **values(**changes))
    assert complaint(tmp_path / "a.npz") == expected


def test_a_missing_array_or_file_is_named(tmp_path):
    np.savez(tmp_path / "a.npz", points=values()["points"])
    assert complaint(tmp_path / "a.npz") == "lit: expected an array, found none"
    assert complaint(tmp_path / "b.npz") == "expected a file, found none"


def test_other_files_are_refused(tmp_path):
    """A single array under the name of an archive, pickled objects, a folder, text."""
    path = tmp_path / "a.npz"
    with path.open("wb") as file:
        np.save(file, np.ones(3))
    assert "expected an npz file" in complaint(path)
    np.savez(path, points=np.array([{}], object), lit=np.array([None]))
    assert "expected an npz file" in complaint(path)
    path.write_text("hello")
    assert "expected an npz file" in complaint(path)
    assert complaint(tmp_path) == "expected a file, found a folder"


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_damage_is_one_line(tmp_path, rng, save):
    """Bytes changed at random in the archive: either it doesn't matter, or it is said in one line."""
    path = tmp_path / "a.npz"
    save(path, **values())
    whole = np.frombuffer(path.read_bytes(), np.uint8)
    refused = 0
    for _ in range(400):
        spoilt = whole.copy()
        spoilt[rng.integers(len(whole), size=2)] = rng.integers(256, size=2)
        path.write_bytes(spoilt.tobytes())
        try:
            npz.read(path, FORMS)
        except InputError as error:
            assert re.fullmatch(r"[^\n]*expected [^\n]*found [^\n]*", str(error))
            refused += 1
    assert refused > 100


def test_damaged_headers_are_one_line(tmp_path, rng):
    """The same within an array's own header, in an archive that is whole."""
    header = io.BytesIO()
    np.save(header, values()["points"])
    whole = np.frombuffer(header.getvalue(), np.uint8)
    signs = np.frombuffer(b"(){}[],:' 0198-<f\n", np.uint8)
    for _ in range(400):
        spoilt = whole.copy()
        spoilt[rng.integers(75, size=3)] = rng.choice(signs, 3)
        with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
            archive.writestr("points.npy", spoilt.tobytes())
        complaint(tmp_path / "a.npz")  # at best, lit is missing
