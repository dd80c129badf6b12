"""Discs in a square grid."""

from typing import Literal

from recon.board_detection.circle_grid import find_circles
from recon.board_detection.findings import Detection
from recon.model.boards import Array, Discs, grid


class SymmetricCircles(Discs):
    """Discs in a square grid. Half a turn maps it onto itself; the turn of each pose follows from the errors of the print."""

    NEIGHBOURS = ((1, 0), (0, 1))
    kind: Literal["symmetric_circles"] = "symmetric_circles"

    def points(self) -> Array:
        """Centres of the discs : (columns * rows, 3) mm."""
        return grid(self.columns, self.rows, self.spacing_mm)

    @property
    def half_turn_is_alike(self) -> bool:
        """Whether it looks the same after half a turn."""
        return True

    def find(self, image: Array, full: float) -> Detection:
        """Its discs in an image, as of `recon.board_detection.detect.detect`."""
        return find_circles(image, self, full)


Kind = SymmetricCircles
