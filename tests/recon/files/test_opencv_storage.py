"""OpenCV FileStorage: the values of OpenCV's own reader, and no file that breaks ours."""

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from recon.errors import InputError
from recon.files import opencv_storage
from tests.recon import bounded_work
from tests.recon.files.mutations import damaged

MATRICES = {
    "decimal": np.array([[1, -2.5e-7, 1e300], [np.nan, np.inf, -np.inf]]),
    "single": np.array([[0.1, 3.0]], np.float32),
    "half": np.array([[0.1, 3.0]], np.float16),
    "bytes": np.arange(6, dtype=np.uint8).reshape(2, 3),
    "signed": np.array([[-128, 127]], np.int8),
    "words": np.array([[0, 65535]], np.uint16),
    "shorts": np.array([[-32768, 32767]], np.int16),
    "whole": np.array([[-(2**31), 2**31 - 1]], np.int32),
    "colours": np.arange(12, dtype=np.uint8).reshape(2, 2, 3),
    "points": np.arange(8.0).reshape(2, 2, 2),
    "three": np.arange(24, dtype=np.float32).reshape(2, 3, 4),
}


def stored(suffix: str, packed: bool = False) -> str:
    """All that calibrations hold, as OpenCV writes it."""
    flags = cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY | (cv2.FileStorage_BASE64 if packed else 0)
    storage = cv2.FileStorage(suffix, flags)
    for name, matrix in MATRICES.items():
        if not (packed and matrix.dtype == np.float16):  # which OpenCV doesn't pack
            storage.write(name, matrix)
    for name, value in (("text", "a \\ word"), ("digits", "12"), ("count", 3), ("speed", 1488.25), ("none", np.nan)):
        storage.write(name, value)
    storage.writeComment("a comment: { [ \n of two lines")
    storage.startWriteStruct("names", cv2.FileNode_SEQ)
    storage.write("", "cam1.fx")
    storage.write("", "a b")
    storage.endWriteStruct()
    storage.startWriteStruct("device", cv2.FileNode_MAP)
    storage.startWriteStruct("size", cv2.FileNode_SEQ | cv2.FileNode_FLOW)
    storage.write("", 640)
    storage.write("", 480)
    storage.endWriteStruct()
    storage.write("matrix", np.eye(3))
    storage.endWriteStruct()
    return storage.releaseAndGetString()


@pytest.fixture
def read(tmp_path):
    def reader(text: str | bytes):
        path = tmp_path / "file"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return opencv_storage.read(path, "a file"), path

    return reader


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("suffix", [".yaml", ".xml", ".json"])
def test_values_are_those_that_opencv_reads(read, suffix, packed):
    text = stored(suffix, packed)
    values, path = read(text)
    theirs = cv2.FileStorage(text, cv2.FileStorage_READ | cv2.FileStorage_MEMORY)
    for name in MATRICES.keys() & values.keys():
        expected = theirs.getNode(name).mat()
        np.testing.assert_array_equal(opencv_storage.matrix(path, name, values[name]), np.asarray(expected, float))
    for name in ("text", "digits"):
        assert values[name] == theirs.getNode(name).string()
    assert values["count"] == 3 and values["speed"] == 1488.25 and str(values["none"]).strip(".").lower() == "nan"
    assert values["names"] == ["cam1.fx", "a b"] and values["device"]["size"] == [640, 480]
    np.testing.assert_array_equal(opencv_storage.matrix(path, "", values["device"]["matrix"]), np.eye(3))


@pytest.mark.parametrize(
    "text",
    [
        "%YAML:1.0\n# of 2013\nM: !!opencv-matrix\n   rows: 1\n   cols: 2\n   dt: d\n   data: [ 1., .5 ]\n",
        "%YAML:1.0\n---\nM: !!opencv-matrix\n   rows: 1\n   cols: 2\n   dt: d\n   data:\n    - 1.\n    - 5e-1\n...\n---\nN: 3\n",
        '\ufeff%YAML 1.0\n---\nM: !!opencv-nd-matrix\n   sizes: [1, 2]\n   dt: "1d"\n   data: [ 1, 0.5 ]\n',
        "%YAML:1.0\r\n---\r\nM: {rows: 1, cols: 2, dt: d, data: [1.,0.5]}\r\n",
        '<?xml version="1.0"?>\n<opencv_storage><M type_id="opencv-matrix"><rows>1</rows><cols>2</cols><dt>d</dt>'
        "<data>1. 5.0e-01</data></M></opencv_storage>",
        '{"M": {"type_id": "opencv-matrix", "rows": 1, "cols": 2, "dt": "d", "data": [1., 5e-1] // half\n}}',
    ],
)
def test_older_files_and_those_of_other_programs_are_read(read, text):
    values, path = read(text)
    np.testing.assert_array_equal(opencv_storage.matrix(path, "M", values["M"]), [[1, 0.5]])


def test_a_calibration_with_its_images_points_is_read(read):
    """1000 views of 54 corners, as OpenCV's calibration sample stores them: the same from YAML as from XML."""
    points = np.random.default_rng(0).uniform(0, 1280, (1000, 54, 2)).astype(np.float32)
    found = {}
    for suffix in (".yaml", ".xml"):
        storage = cv2.FileStorage(suffix, cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
        storage.write("image_points", points)
        storage.write("camera_matrix", np.eye(3))
        values, path = read(storage.releaseAndGetString())
        found[suffix] = opencv_storage.matrix(path, "image_points", values["image_points"])
    np.testing.assert_array_equal(found[".yaml"], points)
    np.testing.assert_array_equal(found[".yaml"], found[".xml"])


def test_aliases_stand_for_values_but_not_for_more_than_a_file_has_bytes(read):
    values, _ = read("%YAML:1.0\n---\na: &a [1, 2]\nb: *a\nc: {d: *a, *a : 3}\n1e3: x\n")
    assert values == {"a": [1, 2], "b": [1, 2], "c": {"d": [1, 2]}, "1e3": "x"}
    bomb = "%YAML:1.0\n---\na: &a [l, o, l, l, l, l, l, l, l]\n" + "".join(
        f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
    )
    with pytest.raises(InputError, match=r"expected YAML of up to \d+ values, found more, written out or as aliases$"):
        read(bomb)


def test_a_file_that_is_too_large_is_refused_with_a_way_on(read, monkeypatch):
    """An npz file may be larger: its own reader bounds it."""
    monkeypatch.setattr(opencv_storage, "MOST_BYTES", 50)
    with pytest.raises(InputError, match=r"expected a file of up to 0 MiB, found more: leave out .* as npz$"):
        read(MATRIX)
    assert read(b"PK" + bytes(200))[0] is None


MATRIX = "%YAML:1.0\n---\nM: !!opencv-matrix\n   rows: 1\n   cols: 2\n   dt: d\n   data: [ 3320., 0.5 ]\n"


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        ("   cols: 2\n", "", "M.cols: expected a whole number, found none"),
        ("cols: 2", "cols: -2", "M.cols: expected a whole number, found something else"),
        ("cols: 2", "cols: 3", "M: expected 1 x 3 numbers, as it declares, found 2"),
        ("rows: 1", "rows: 1000000000000", "M: expected 1000000000000 x 2 numbers, as it declares, found 2"),
        ("dt: d", "dt: u", "M: expected whole numbers of 0 to 255, as dt declares, found 3320: should dt be d?"),
        ("dt: d", "dt: i", "M: expected whole numbers of -2147483648 to 2147483647, as dt declares, found 0.5: should dt be d?"),
        (
            "dt: d",
            "dt: q",
            "M.dt: expected one of u, c, w, s, i, f, d, h, b, n, I, U, perhaps after a number of channels, found 'q'",
        ),
        ("dt: d", 'dt: "2d"', "M: expected 1 x 2 x 2 numbers, as it declares, found 2"),
        ("0.5", "half", "M: expected a matrix of numbers, found 'half' among them"),
        ("0.5", "[ 1 ]", "M: expected a matrix of numbers, found [1] among them"),
        ("[ 3320., 0.5 ]", "!!binary |\n      MWYg", "M: expected packed numbers of its type, found other or damaged data"),
        ("   data: [ 3320., 0.5 ]\n", "", "M: expected a matrix, found something else"),
    ],
)
def test_a_matrix_that_declares_something_else_is_refused(read, before, after, complaint):
    assert before in MATRIX
    values, path = read(MATRIX.replace(before, after))
    with pytest.raises(InputError) as refusal:
        opencv_storage.matrix(path, "M", values["M"])
    assert str(refusal.value) == f"{path}: {complaint}"


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), suffix=st.sampled_from([".yaml", ".xml", ".json"]), packed=st.booleans())
def test_a_damaged_file_gives_values_or_one_line(read, data, suffix, packed):
    spoilt = data.draw(damaged(stored(suffix, packed).encode()))
    try:
        with bounded_work.calls(1e5):
            values, path = read(spoilt)
            for name, value in (values or {}).items():
                opencv_storage.matrix(path, name, value)
    except InputError as error:
        assert "\n" not in str(error)
