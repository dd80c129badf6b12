"""The blur of a board's image is measured in pixels, and motion is told from a lens out of focus."""

import cv2
import numpy as np
import pytest

from recon.board_detection.kinds.chessboard import Chessboard
from recon.board_guidance.pose_verdict import board_blur
from recon.geometry import rigid
from recon.geometry.camera import Camera
from tests.recon import board_views
from tests.recon.board_guidance.held_boards import photograph
from tests.recon.board_sets import BOARD

CAMERA = Camera((640, 512), np.array([[1660.0, 0, 320], [0, 1660, 256], [0, 0, 1]]), np.zeros(0))


def photographed(board, rng):
    """A sharp view, and the points in it."""
    pose = board_views.pose(board, 660, (0.2, -0.1), 0.1)
    return photograph(CAMERA, board, pose, rng), CAMERA.project(rigid.apply(pose, board.points()))


@pytest.mark.parametrize("board", [BOARD, Chessboard(columns=6, rows=5, square_mm=20)])
def test_defocus_is_measured(rng, board):
    """Widths add in squares; the photograph has one of its own. A chessboard's edges don't lie across all directions."""
    image, pixels = photographed(board, rng)
    own = board_blur(image, pixels).least
    found = board_blur(cv2.GaussianBlur(image, (0, 0), 2.0), pixels)
    assert own < 1.5
    assert found.least == pytest.approx(np.hypot(2.0, own), rel=0.2)
    assert found.most < 1.6 * found.least


def test_motion_shows_in_its_direction_alone(rng):
    """A way of 12 px during the exposure lowers the steepest slope to contrast / 12 px along it."""
    image, pixels = photographed(BOARD, rng)
    kernel = np.full((1, 12), 1 / 12)
    found = board_blur(cv2.filter2D(image, -1, kernel), pixels)
    assert found.least < 1.5
    assert found.most == pytest.approx(12 / np.sqrt(2 * np.pi), rel=0.25)
