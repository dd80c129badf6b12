"""Rigid transforms keep what rigid motion keeps."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.geometry import rigid

angles = st.tuples(*[st.floats(-3, 3)] * 3)
lengths = st.tuples(*[st.floats(-1000, 1000)] * 3)
poses = st.builds(rigid.from_rotation_vector, angles, lengths)
CLOSE = 1e-9  # mm: rounding at lengths of a metre is 1e-13, the rest is margin for sums


@given(poses, lengths, lengths)
def test_distances_are_kept(pose, a, b):
    moved = np.linalg.norm(rigid.apply(pose, a) - rigid.apply(pose, b))
    assert abs(moved - np.linalg.norm(np.subtract(a, b))) < CLOSE


@given(poses, lengths)
def test_the_inverse_undoes(pose, point):
    assert np.abs(rigid.apply(rigid.invert(pose), rigid.apply(pose, point)) - point).max() < CLOSE
    assert np.abs(rigid.invert(pose) @ pose - np.eye(4)).max() < CLOSE


@given(poses, poses, lengths)
def test_products_apply_right_to_left(a_from_b, b_from_c, point):
    stepwise = rigid.apply(a_from_b, rigid.apply(b_from_c, point))
    assert np.abs(rigid.apply(a_from_b @ b_from_c, point) - stepwise).max() < CLOSE


@given(poses, lengths, lengths)
def test_directions_ignore_the_translation(pose, a, b):
    difference = rigid.apply(pose, a) - rigid.apply(pose, b)
    assert np.abs(rigid.rotate(pose, np.subtract(a, b)) - difference).max() < CLOSE


def test_a_quarter_turn_about_z_takes_x_to_y():
    pose = rigid.from_rotation_vector([0, 0, np.pi / 2], [0, 0, 5])
    assert np.allclose(rigid.apply(pose, [1, 0, 0]), [0, 1, 5])


@given(poses, st.tuples(*[st.floats(-1.7, 1.7)] * 3, *[st.floats(-1000, 1000)] * 3))
def test_a_difference_undoes_a_step(pose, step):
    """Turns of less than half a circle are told from all others: 1.7 rad about each axis are 2.94 together."""
    assert np.abs(rigid.difference(pose, rigid.moved(pose, step)) - step).max() < CLOSE


@given(poses, st.integers(0, 3), st.integers(0, 3), st.floats(0.01, 2))
def test_a_rigid_transform_is_told_from_other_matrices(pose, row, column, change):
    """No entry of a rotation changes alone: a row gets another length, two rows another angle, or the frame is mirrored."""
    assert rigid.fault(pose) is None
    assert "left-handed" in rigid.fault(pose @ np.diag([1.0, 1, -1, 1]))
    assert "not finite" in rigid.fault(np.full((4, 4), np.nan)) and "4x4" in rigid.fault(np.eye(3))
    other = pose.copy()
    other[row, column] += change
    if row == 3:
        assert f"last row than 0 0 0 1: {' '.join(f'{value:.9g}' for value in other[3])}" == rigid.fault(other)[8:]
    elif column == 3:
        assert rigid.fault(other) is None
    else:
        assert rigid.fault(other, 1e-5) is not None


@given(poses)
def test_the_last_row_has_all_digits_however_few_the_rotation_has(pose):
    other = pose.copy()
    other[3, 1] = 1e-8
    assert rigid.fault(other, 1e-3) == "another last row than 0 0 0 1: 0 1e-08 0 1"


def test_a_matrix_that_is_no_rotation_is_shown():
    pose = np.eye(4)
    pose[0, 1] = 1.25e-3
    assert rigid.fault(pose) == "a matrix that is no rotation: 1 0.00125 0; 0 1 0; 0 0 1"


@given(poses)
def test_the_nearest_rotation_is_no_farther_than_the_one_that_was_rounded(pose):
    """Each of nine entries is off by at most half a unit of the fifth decimal."""
    rounded = np.round(pose, 5)
    found = rigid.nearest(rounded)
    assert rigid.fault(found, CLOSE) is None and np.array_equal(found[:3, 3], rounded[:3, 3])
    assert np.linalg.norm(found[:3, :3] - rounded[:3, :3]) <= np.linalg.norm(pose[:3, :3] - rounded[:3, :3]) + CLOSE


@given(poses)
def test_the_nearest_transform_of_a_mirrored_frame_is_no_mirror(pose):
    """Whatever the axis: what is nearest is still rigid."""
    for axis in range(3):
        mirrored = pose.copy()
        mirrored[:3, axis] *= -1
        assert rigid.fault(rigid.nearest(mirrored), CLOSE) is None


@pytest.mark.parametrize(("rotation", "translation"), [(np.eye(3), 5.0), (1.0, [1, 2, 3]), ([1, 0, 0], [1, 2, 3])])
def test_shapes_are_not_filled_up(rotation, translation):
    """A shift that is one number isn't that along all three axes."""
    with pytest.raises(ValueError, match="expected a 3x3 rotation and 3 translations, found"):
        rigid.transform(rotation, translation)


@given(poses, angles, lengths)
def test_a_step_turns_about_the_origin_and_then_shifts(pose, turn, shift):
    stepped = rigid.moved(pose, [*turn, *shift])
    about_origin = rigid.transform(np.eye(3), pose[:3, 3] + shift) @ rigid.from_rotation_vector(turn, np.zeros(3))
    assert np.abs(stepped - about_origin @ rigid.transform(pose[:3, :3], np.zeros(3))).max() < CLOSE


@given(st.lists(st.tuples(poses, angles, lengths), min_size=1, max_size=4))
def test_many_steps_are_each_by_itself(several):
    steps = [[*turn, *shift] for _, turn, shift in several]
    together = rigid.moved(np.array([pose for pose, *_ in several]), steps)
    assert np.array_equal(together, [rigid.moved(pose, step) for (pose, *_), step in zip(several, steps, strict=True)])


@given(poses, lengths)
def test_slopes_are_those_of_a_step(pose, point):
    """Central differences of 1e-4 rad and mm: their error is the third derivative's, 1e-9 / 6 of an arm of 1.7 m."""
    differences = [
        (rigid.apply(rigid.moved(pose, step), point) - rigid.apply(rigid.moved(pose, -step), point)) / 2e-4
        for step in 1e-4 * np.eye(6)
    ]
    assert np.abs(rigid.slopes(rigid.rotate(pose, point)) - np.stack(differences, axis=-1)).max() < 1e-5


def test_many_points_keep_their_shape():
    pose = rigid.from_rotation_vector([0.1, 0.2, 0.3], [1, 2, 3])
    points = np.arange(24.0).reshape(2, 4, 3)
    assert rigid.apply(pose, points).shape == points.shape
    assert np.allclose(rigid.apply(pose, points)[1, 2], rigid.apply(pose, points[1, 2]))
