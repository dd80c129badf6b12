"""Half turns of boards that are mapped onto themselves."""

import tracemalloc

import numpy as np
import pytest

from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.board_detection.kinds.chessboard import Chessboard
from recon.board_detection.kinds.symmetric_circles import SymmetricCircles
from recon.optical_calibration.half_turns import half_turn


@pytest.mark.parametrize(
    ("board", "symmetric"),
    [
        (SymmetricCircles(columns=60, rows=60, spacing_mm=5, diameter_mm=3), True),
        (Chessboard(columns=9, rows=7, square_mm=10), True),
        (Chessboard(columns=9, rows=6, square_mm=10), False),
        (AsymmetricCircles(columns=4, rows=10, spacing_mm=15, diameter_mm=10), True),
        (AsymmetricCircles(columns=4, rows=11, spacing_mm=15, diameter_mm=10), False),
    ],
)
def test_half_a_turn_puts_points_on_points(board, symmetric):
    """Of 3600 discs without all their 13 million pairs in memory."""
    tracemalloc.start()
    turn = half_turn(board)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (turn is not None) == symmetric and most < 30e6
    if turn is not None:
        points = board.points()
        np.testing.assert_allclose(points[turn] + points, np.broadcast_to(points.min(0) + points.max(0), points.shape), atol=1e-6)
