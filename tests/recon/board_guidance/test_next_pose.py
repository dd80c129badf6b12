"""The pose that is asked for adds more than others, lies in all views, and can be shown to a person."""

import numpy as np

from recon.board_detection.kinds.chessboard import Chessboard
from recon.board_guidance.board_room import ALIKE_DEG, ALIKE_MM, apart, candidates, fits, reach_of
from recon.board_guidance.next_pose import NOISE_PX, few, knowledge, suggest
from recon.board_guidance.pose_information import of_rig
from tests.recon.board_guidance.held_boards import kept, posed, spread
from tests.recon.board_sets import BOARD, devices

NONE = np.zeros((0, 4, 4))


def test_the_first_pose_needs_no_calibration(rig, rng):
    asked = suggest(None, NONE, rig, BOARD, rng)
    assert fits(asked.world_from_board[None], BOARD, devices(rig), reach_of(rig))[0]
    assert 0 < asked.gain < 1 and asked.words.startswith("hold it at ")


def test_after_boards_all_straight_a_tilted_one_is_asked_for(rig, rng):
    """Focal length and distance can't be told apart by parallel boards."""
    straight = np.array([posed((x, 0, 660)) for x in (-30, 0, 30)])
    asked = suggest(None, straight, rig, BOARD, rng).world_from_board
    assert np.rad2deg(np.arccos(asked[2, 2])) > 15


def test_the_asked_pose_adds_more_than_a_random_one_and_far_more_than_an_old_one(rig, rng):
    so_far = kept(rig, spread(rig, 5, rng), rng)
    asked = suggest(so_far.calibration, so_far.poses, rig, BOARD, rng, noise=so_far.noise)
    known = knowledge(so_far.calibration, so_far.poses, rig, BOARD, reach_of(rig), so_far.noise)
    others = known.gains(candidates(BOARD, devices(rig), reach_of(rig), 50, rng), few(BOARD.points()))
    again = known.gains(so_far.poses, few(BOARD.points()))
    assert asked.gain > np.quantile(others, 0.9)
    assert asked.gain > 1.3 * np.median(again)


def test_few_points_stand_for_all_of_a_board(rig, rng):
    """Gains by 24 of a chessboard's 400 corners, with as much less noise, are those by all, but for the places of the corners."""
    board, reach = Chessboard(columns=20, rows=20, square_mm=7), reach_of(rig)
    poses = candidates(board, devices(rig), reach, 8, rng)
    thinned = knowledge(None, poses[:4], rig, board, reach, NOISE_PX).gains(poses[4:], few(board.points()))
    whole = of_rig(devices(rig), NOISE_PX, poses[:4], board.points(), reach.volume_mm).gains(poses[4:], board.points())
    np.testing.assert_allclose(thinned, whole, rtol=0.25)


def test_the_drawing_is_where_camera_1_would_see_the_board(rig, rng):
    asked = suggest(None, NONE, rig, BOARD, rng)
    width, height = devices(rig)["cam1"].size
    assert (asked.outline >= 0).all() and (asked.outline <= [width, height]).all()
    assert (asked.outline[0] == asked.outline[-1]).all()
    low, high = asked.outline.min(axis=0), asked.outline.max(axis=0)
    assert asked.points.shape == (44, 2) and (asked.points > low).all() and (asked.points < high).all()


def test_the_same_generator_asks_for_the_same_pose(rig):
    first, second = (suggest(None, NONE, rig, BOARD, np.random.default_rng(3)).world_from_board for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_no_pose_is_asked_for_twice(rig, rng):
    """Each asked pose is held exactly; none of the later ones would be refused as like it."""
    asked = NONE
    for _ in range(10):
        pose = suggest(None, asked, rig, BOARD, rng).world_from_board[None]
        apart_mm, apart_deg = apart(pose, asked, BOARD)
        assert ((apart_mm > 2 * ALIKE_MM) | (apart_deg > 2 * ALIKE_DEG)).all()
        asked = np.concatenate([asked, pose])
