"""Rigid transforms keep what rigid motion keeps."""

import numpy as np
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


def test_many_points_keep_their_shape():
    pose = rigid.from_rotation_vector([0.1, 0.2, 0.3], [1, 2, 3])
    points = np.arange(24.0).reshape(2, 4, 3)
    assert rigid.apply(pose, points).shape == points.shape
    assert np.allclose(rigid.apply(pose, points)[1, 2], rigid.apply(pose, points[1, 2]))
