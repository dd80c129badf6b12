"""Discs in rows that stand half a step off each other."""

from typing import Literal

import numpy as np

from recon.board_detection.circle_grid import find_circles
from recon.board_detection.findings import Detection
from recon.model.boards import Array, Discs


class AsymmetricCircles(Discs):
    """Discs in rows that stand half a step off each other: circles of a row stand two spacings apart, rows one."""

    NEIGHBOURS = ((1, 1), (-1, 1))
    kind: Literal["asymmetric_circles"] = "asymmetric_circles"

    def points(self) -> Array:
        """Centres of the discs : (columns * rows, 3) mm."""
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        return np.column_stack([2 * column + row % 2, row, np.zeros(row.size)]) * self.spacing_mm

    @property
    def half_turn_is_alike(self) -> bool:
        """Whether it looks the same after half a turn."""
        return self.rows % 2 == 0

    def find(self, image: Array, full: float) -> Detection:
        """Its discs in an image, as of `recon.board_detection.detect.detect`."""
        return find_circles(image, self, full)


Kind = AsymmetricCircles
