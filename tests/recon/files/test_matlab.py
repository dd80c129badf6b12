"""MATLAB's files: do the matrices come back, and is everything else refused in one line?"""

import io
import struct

import numpy as np
import pytest
from scipy.io import savemat

from recon.errors import InputError
from recon.files import matlab
from recon.files.npz import Form

MATRICES = {
    "K": np.array([[2518.5, 0, 649.1], [0, 2518.1, 506.1], [0, 0, 1]]),
    "t": np.array([[-302.2], [-9.5], [60.1]], np.float32),
    "n": np.array([[3, -4, 5]], np.int16),
    "x": np.array([[7]], np.uint8),
}
FORMS = {"K": Form("f", (3, 3)), "t": Form("f", (3, 1)), "n": Form("fiu"), "x": Form("fiu")}


def saved(**options) -> bytes:
    file = io.BytesIO()
    savemat(file, MATRICES | {"name": "rig", "points": {"left": [1.0, 2.0]}, "wave": np.array([1j])}, **options)
    return file.getvalue()


def element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


@pytest.mark.parametrize("packed", [False, True])
def test_matrices_come_back(tmp_path, packed):
    """As another program writes them; text, structures and complex numbers beside them don't matter."""
    path = tmp_path / "a.mat"
    path.write_bytes(saved(do_compression=packed))
    assert matlab.is_matlab(path)
    found = matlab.read(path, FORMS, {})
    assert list(found) == list(FORMS)
    for name, values in found.items():
        assert values.dtype.kind == MATRICES[name].dtype.kind and np.array_equal(values, MATRICES[name]), name


@pytest.mark.parametrize("packed", [False, True])
def test_other_variables_may_have_any_size(tmp_path, packed):
    """Frames beside the matrices, of more than is ever unpacked; a wanted matrix of that size is named with it."""
    path, large = tmp_path / "a.mat", np.zeros((5, 700, 700))
    file = io.BytesIO()
    savemat(file, {"frames": large, **MATRICES, "zlast": large}, do_compression=packed)
    path.write_bytes(file.getvalue())
    assert np.array_equal(matlab.read(path, FORMS, {})["K"], MATRICES["K"])
    with pytest.raises(InputError, match=r"a\.mat: frames: expected a matrix of up to 16 MiB, found 19 MiB$"):
        matlab.read(path, {"frames": Form("f")}, {})


def test_an_old_name_is_taken_for_the_new_one(tmp_path):
    path = tmp_path / "a.mat"
    path.write_bytes(saved())
    assert np.array_equal(matlab.read(path, {"matrix": FORMS["K"]}, {"K": "matrix"})["matrix"], MATRICES["K"])


def test_a_file_of_the_other_byte_order(tmp_path):
    flags, shape = struct.pack(">IIII", 6, 8, 6, 0), struct.pack(">IIii", 5, 8, 1, 2)
    name, values = struct.pack(">HHc3x", 1, 1, b"t"), struct.pack(">IIdd", 9, 16, 1.5, -2.5)
    content = flags + shape + name + values
    path = tmp_path / "a.mat"
    path.write_bytes(b"MATLAB 5.0".ljust(124) + b"\1\0MI" + struct.pack(">II", 14, len(content)) + content)
    assert matlab.read(path, {"t": Form("f", (1, 2))}, {})["t"].tolist() == [[1.5, -2.5]]


def test_objects_and_newer_files_are_refused_by_the_cause(tmp_path):
    path = tmp_path / "stereoParams.mat"
    opaque = element(14, element(6, struct.pack("<II", 17, 0)) + element(1, b"stereoParams") + element(1, b"MCOS"))
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM" + opaque)
    with pytest.raises(InputError, match="expected matrices K, t, n, x, found a MATLAB object: save its matrices"):
        matlab.read(path, FORMS, {})
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512))
    with pytest.raises(InputError, match=r"found 7\.3: save it with -v7$"):
        matlab.read(path, FORMS, {})


def test_damage_is_refused(tmp_path, rng):
    """Cut anywhere, or with some bytes wrong: refused in one line, or read where the damage lies elsewhere."""
    path, refused = tmp_path / "a.mat", 0
    for number in range(600):
        data = bytearray(saved(do_compression=number % 2 == 0))
        if number % 3 == 0:
            del data[rng.integers(20, len(data)) :]
        else:
            data[rng.integers(124, len(data))] = rng.integers(256)
        path.write_bytes(bytes(data))
        try:
            matlab.read(path, FORMS, {})
        except InputError as error:
            assert "\n" not in str(error)
            refused += 1
    assert refused > 200
