"""Words lead a person from the pose that is held to the one asked for."""

import numpy as np
import pytest

from recon.board_guidance.pose_words import angles, moves, placed, there
from tests.recon.board_guidance.held_boards import posed
from tests.recon.board_sets import BOARD

HELD = posed((0, 0, 660))


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (posed((0, 0, 600)), "60 mm nearer"),
        (posed((0, 0, 720)), "60 mm farther"),
        (posed((-40, 0, 660)), "40 mm to the left"),
        (posed((0, 52, 660)), "50 mm down"),
        (posed((30, -30, 660)), "30 mm to the right, 30 mm up"),
        (posed((0, 0, 660), turn_deg=90), "turn it clockwise by 90 deg"),
        (posed((0, 0, 660), turn_deg=-30), "turn it anticlockwise by 30 deg"),
        (posed((0, 0, 660), (0, 30)), "its right edge 30 deg nearer"),
        (posed((0, 0, 660), (30, 0)), "its upper edge 30 deg nearer"),
        (posed((0, 0, 660), (-30, 0)), "its lower edge 30 deg nearer"),
        (posed((0, 0, 610), (0, -20)), "50 mm nearer, its left edge 20 deg nearer"),
        (posed((5, 5, 655), (3, 3)), "hold still"),
    ],
)
def test_moves_from_a_straight_board(asked, words):
    assert moves(asked, HELD, BOARD) == words


def test_the_named_edge_is_the_one_that_comes_nearer():
    """By the places of the board's own corners, not by angles."""
    for tilt in ((25, 0), (-25, 0), (0, 25), (0, -25)):
        pose = posed((0, 0, 660), tilt)
        corners = BOARD.points()[[0, 3, 40, 43]]  # upper left, upper right, lower left, lower right
        depth = (corners @ pose[:3, :3].T + pose[:3, 3])[:, 2]
        nearer = {
            "upper": depth[:2].mean() < depth[2:].mean(),
            "lower": depth[2:].mean() < depth[:2].mean(),
            "left": depth[[0, 2]].mean() < depth[[1, 3]].mean(),
            "right": depth[[1, 3]].mean() < depth[[0, 2]].mean(),
        }
        edge = moves(pose, HELD, BOARD).split()[1]
        assert nearer[edge] and abs(depth[:2].mean() - depth[2:].mean()) + abs(depth[[0, 2]].mean() - depth[[1, 3]].mean()) > 20


def test_a_turn_goes_the_shorter_way():
    assert moves(posed((0, 0, 660), turn_deg=170), posed((0, 0, 660), turn_deg=-170), BOARD) == "turn it anticlockwise by 20 deg"


def test_half_a_turn_is_none_where_nobody_can_tell():
    alike = BOARD.model_copy(update={"rows": 10})
    turned = posed((0, 0, 660), turn_deg=180)
    assert moves(turned, HELD, BOARD) == "turn it clockwise by 180 deg" or "anticlockwise" in moves(turned, HELD, BOARD)
    assert "turn" not in moves(turned, HELD, alike)
    assert not there(turned, HELD, BOARD)


def test_there_is_within_what_hands_can_do():
    assert there(posed((10, 0, 660), (0, 5)), HELD, BOARD)
    assert not there(posed((20, 0, 660)), HELD, BOARD)
    assert not there(posed((0, 0, 660), (0, 12)), HELD, BOARD)


def test_turn_and_tilts_come_apart():
    found = angles(posed((0, 0, 660), (0, 30), turn_deg=90))
    np.testing.assert_allclose(found, [30, 0, 90], atol=1e-9)


def test_a_pose_by_itself_in_words():
    assert placed(posed((-62, 0, 606), (0, -30), turn_deg=90), BOARD) == (
        "hold it at 610 mm, 60 mm left, turned clockwise by 90 deg, its left edge 30 deg nearer"
    )
    assert placed(HELD, BOARD) == "hold it at 660 mm, in the middle"
