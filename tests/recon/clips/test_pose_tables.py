"""Tables of poses of any columns, units and kinds of rotation give the same track; faults are named by line and column."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.clips import pose_tables
from recon.clips.pose_tables import Columns
from recon.errors import InputError
from recon.geometry import rigid

RNG = np.random.default_rng(3)
POSES = np.stack([rigid.from_rotation_vector(RNG.normal(size=3), 100 * RNG.normal(size=3)) for _ in range(6)])
SECONDS = np.array([10.0, 10.05, 10.1, 10.2, 10.25, 10.3])
HEADER, QUATERNION = "t,x,y,z,a,b,c,d\n", Columns(time="t", translation=("x", "y", "z"), quaternion=("a", "b", "c", "d"))
ROTATION = tuple(f"r{k}" for k in range(9))


def write(path, header, rows, separator=",") -> None:
    lines = [separator.join(header), *(separator.join(f"{value:.12g}" for value in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def assert_same(track) -> None:
    assert track.times.tolist() == np.rint(1e9 * SECONDS).astype(int).tolist()
    assert np.allclose(track.poses, POSES, atol=1e-8)


def test_quaternions_in_metres_and_milliseconds(tmp_path):
    """With columns that nobody asked for, in any order, separated by semicolons."""
    header = ["qw", "note", "x", "y", "z", "stamp", "qx", "qy", "qz"]
    turns = Rotation.from_matrix(POSES[:, :3, :3]).as_quat()
    rows = [
        [turn[3], 7, *(pose[:3, 3] / 1000), 1e3 * time, *turn[:3]] for turn, pose, time in zip(turns, POSES, SECONDS, strict=True)
    ]
    write(tmp_path / "t.csv", header, rows, ";")
    columns = Columns(
        time="stamp", time_unit="ms", translation=("x", "y", "z"), length_unit="m", quaternion=("qx", "qy", "qz", "qw")
    )
    assert_same(pose_tables.read(tmp_path / "t.csv", columns))


@pytest.mark.parametrize("count", [9, 12, 16])
def test_matrices_row_by_row(count, tmp_path):
    names = [f"m{k}" for k in range(count)]
    whole = POSES.reshape(-1, 16)[:, :count] if count > 9 else POSES[:, :3, :3].reshape(-1, 9)
    extra = [] if count > 9 else ["x", "y", "z"]
    rows = np.column_stack([SECONDS, whole, *([] if count > 9 else [POSES[:, :3, 3]])])
    write(tmp_path / "t.csv", ["t", *names, *extra], rows, "\t")
    columns = Columns(time="t", matrix=tuple(names), translation=tuple(extra) or None)
    assert_same(pose_tables.read(tmp_path / "t.csv", columns))


def test_matrices_column_by_column_are_refused(tmp_path):
    """Their last row isn't 0 0 0 1: taken as it stands they would be turned back and lose their place."""
    names = tuple(f"m{k}" for k in range(16))
    write(tmp_path / "t.csv", ["t", *names], np.column_stack([SECONDS, POSES.transpose(0, 2, 1).reshape(-1, 16)]))
    with pytest.raises(InputError, match=r"line 2: expected a rigid transform .* row by row"):
        pose_tables.read(tmp_path / "t.csv", Columns(time="t", matrix=names))


def test_headers_with_blanks_and_columns_set_apart_by_some(tmp_path):
    (tmp_path / "t.csv").write_text("Time (s),X (mm),y,z,a,b,c,d\n0.5,1,2,3,0,0,0,1\n1.5,1,2,3,0,0,0,1\n")
    columns = Columns(time="Time (s)", translation=("X (mm)", "y", "z"), quaternion=("a", "b", "c", "d"))
    assert pose_tables.read(tmp_path / "t.csv", columns).poses[0, :3, 3].tolist() == [1, 2, 3]
    (tmp_path / "t.txt").write_text("t   x y  z a b c d\n0.5  1  2 3 0 0  0 1\n1.5 1 2  3 0 0 0 1\n")
    assert pose_tables.read(tmp_path / "t.txt", QUATERNION).poses[0, :3, 3].tolist() == [1, 2, 3]


def test_inverted_poses_are_turned_around(tmp_path):
    names = [f"m{k}" for k in range(12)]
    write(tmp_path / "t.csv", ["t", *names], np.column_stack([SECONDS, np.linalg.inv(POSES).reshape(-1, 16)[:, :12]]))
    assert_same(pose_tables.read(tmp_path / "t.csv", Columns(time="t", matrix=tuple(names), inverted=True)))


def test_rows_without_values_are_poses_that_were_not_found(tmp_path):
    header = ["t", "x", "y", "z", "a", "b", "c", "d"]
    (tmp_path / "t.csv").write_text(
        ",".join(header) + "\n0.1,1,2,3,0,0,0,1\n0.2,,,,,,,\n0.3,nan,0,0,0,0,0,1\n\n0.4,1,2,3,0,0,1,0\n"
    )
    track = pose_tables.read(tmp_path / "t.csv", Columns(time="t", translation=("x", "y", "z"), quaternion=("a", "b", "c", "d")))
    assert track.found.tolist() == [True, False, False, True] and track.poses[3, 0, 0] == pytest.approx(-1)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("t,x,y,z,a,b,c\n", r"line 1: expected a column d, found t, x, y, z, a, b, c; give columns="),
        (HEADER + "0,0,0,0,0,0,0,1\n", "expected two rows or more"),
        (
            "t,x,y,z,a,b,c,d\n1,0,0,0,0,0,0,1\n0,0,0,0,0,0,0,1\n",
            r"line 3: t: expected a time after that of the row before, found 0",
        ),
        (HEADER + "0,0,0,0,0,0,0,1\n1,0,0,0,0,0,0,2\n", r"line 3: quaternion: expected a length of 1, found 2"),
        (HEADER + "0,0,0,0,0,0,0,1\n1,0,left,0,0,0,0,1\n", r"line 3: y: expected a number, found 'left'"),
        (HEADER + "0,0,0,0,0,0,0,1\n,0,0,0,0,0,0,1\n", r"line 3: t: expected a time, found none"),
        ("", "line 1: expected a column t, found none"),
        (HEADER + "0,0,0,0,0,0,0,1\n1,0,0,0,0,0,0,1,8\n", r"line 3: expected 8 values, as the header has, found 9"),
        (HEADER + "1,,,,,,,\n2,,,,,,,\n", "expected a row with values in all of t, x, y, z, a, b, c, d, found none"),
        (HEADER + "1.7e18,0,0,0,0,0,0,1\n1.8e18,0,0,0,0,0,0,1\n", r"line 3: t: expected seconds below 9e\+09; another unit\?"),
    ],
)
def test_faults_are_named_by_line_and_column(text, complaint, tmp_path):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError, match=complaint):
        pose_tables.read(tmp_path / "t.csv", QUATERNION)


def test_a_mirrored_matrix_is_refused(tmp_path):
    mirrored = POSES @ np.diag([1.0, 1.0, -1.0, 1.0])
    rows = np.column_stack([SECONDS, mirrored[:, :3, :3].reshape(-1, 9), mirrored[:, :3, 3]])
    write(tmp_path / "t.csv", ["t", *ROTATION, "x", "y", "z"], rows)
    with pytest.raises(InputError, match=r"line 2: expected a rigid transform of a right-handed frame"):
        pose_tables.read(tmp_path / "t.csv", Columns(time="t", matrix=ROTATION, translation=("x", "y", "z")))


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({}, "expected quaternion or matrix, found neither"),
        ({"quaternion": tuple("abcd"), "matrix": ROTATION}, "found both"),
        ({"quaternion": tuple("abcd")}, "translation: expected with a quaternion"),
        ({"matrix": ROTATION[:5], "translation": tuple("xyz")}, "expected 9, 12 or 16 columns, found 5"),
    ],
)
def test_columns_that_make_no_pose_are_refused(fields, complaint):
    with pytest.raises(ValueError, match=complaint):
        Columns(time="t", **fields)


NUMBERED = Columns.model_validate({"time": 1, "translation": [2, 3, 4], "quaternion": [5, 6, 7, 8]})
ROWS = np.column_stack([SECONDS, POSES[:, :3, 3], Rotation.from_matrix(POSES[:, :3, :3]).as_quat()])


def test_tables_without_a_header_have_numbered_columns(tmp_path):
    np.savetxt(tmp_path / "t.txt", ROWS, "%.12g")
    assert_same(pose_tables.read(tmp_path / "t.txt", NUMBERED))
    with pytest.raises(InputError, match=r"line 1: expected a column t, found 8 numbers; without a header give columns by their"):
        pose_tables.read(tmp_path / "t.txt", NUMBERED.model_copy(update={"time": "t"}))


def test_tables_without_times_have_a_row_a_frame(tmp_path):
    np.savetxt(tmp_path / "t.txt", ROWS, "%.12g")
    times, columns = np.rint(1e9 * SECONDS).astype(int), NUMBERED.model_copy(update={"time": None})
    assert_same(pose_tables.read(tmp_path / "t.txt", columns, times))
    with pytest.raises(InputError, match=r"expected a row for each of 2 frames of the clip, where columns.time is null, found"):
        pose_tables.read(tmp_path / "t.txt", columns, times[:2])


@pytest.mark.parametrize("lost", [0, 3, 5])
@pytest.mark.parametrize("timed", [True, False])
def test_an_empty_row_is_a_pose_that_was_not_found_and_no_header(timed, lost, tmp_path):
    """The first row too; a table's own numbers of columns, over numbers of rows, are a header still."""
    path, times = tmp_path / "t.csv", np.rint(1e9 * SECONDS).astype(int)
    columns = NUMBERED if timed else NUMBERED.model_copy(update={"time": None})
    rows = [",".join(f"{value:.12g}" for value in row) for row in ROWS]
    rows[lost] = f"{SECONDS[lost]:g}" * timed + 7 * ","
    for below in ("", "" if timed else 2 * f"\n{7 * ','}"):
        path.write_text("\n".join(rows) + below)
        read = pose_tables.read(path, columns, None if timed else times)
        assert np.flatnonzero(~read.found).tolist() == [lost]
        assert np.allclose(read.poses[read.found], np.delete(POSES, lost, axis=0), atol=1e-8)
    path.write_text("\n".join([",0,1,2,3,4,5,6", *(f"{k},{row.partition(',')[2]}" for k, row in enumerate(rows))]))
    by_name = Columns(time=None, translation=("0", "1", "2"), quaternion=("3", "4", "5", "6"))
    assert np.flatnonzero(~pose_tables.read(path, by_name, times).found).tolist() == [lost]


def test_rows_that_repeat_a_time_are_left_out_with_a_count(tmp_path, caplog):
    """The first of them counts, or the first with a pose; where most repeat, the clock stood still."""
    lost = ROWS[1].copy()
    lost[1:] = -3.697314e28
    np.savetxt(tmp_path / "t.txt", np.vstack([ROWS[:1], lost, ROWS[1], ROWS[1] + [0, 5, 0, 0, 0, 0, 0, 0], ROWS[2:]]), "%.12g")
    assert_same(pose_tables.read(tmp_path / "t.txt", NUMBERED))
    assert f"left out 2 of {len(ROWS) + 2} rows, from line 3 on, with the time of the row before" in caplog.text
    np.savetxt(tmp_path / "t.txt", ROWS * [0, 1, 1, 1, 1, 1, 1, 1], "%.12g")
    with pytest.raises(InputError, match=r": 1: expected a time of its own in most rows, found"):
        pose_tables.read(tmp_path / "t.txt", NUMBERED)
