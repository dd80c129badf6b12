"""Rows of what is printed and projected: none is left out without a word."""

import pytest

from recon.errors import InputError
from recon.model.boards import Discs
from tests.twin.experiments.asked import rows
from twin.experiments import trust_accuracy

FOUND = {"dpi": 600.0, "points_mm": 0.0}


@pytest.mark.parametrize("board", trust_accuracy.BOARDS)
def test_boards_of_discs_have_a_row_of_diameters(board):
    """Where a detector gives none, the row is refused, not left out."""
    names = [row.figure for row in rows(trust_accuracy.printed_board, FOUND | {"diameters_mm": 0.0}, board=board)]
    discs = isinstance(trust_accuracy.BOARDS[board], Discs)
    assert names == ["points_mm", "diameters_mm"][: 1 + discs]
    if discs:
        with pytest.raises(InputError, match="diameters_mm"):
            rows(trust_accuracy.printed_board, FOUND, board=board)
