"""Calibration boards by their design: which points they carry, in which order, and where these lie.

Board frame: x to the right, y down, z away from the viewer, origin at the first point. Points come in OpenCV's order, row by row.
"""

from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from recon.model.lengths import BOARD_STEP
from recon.model.rig import Part, Positive

Array = NDArray[np.float64]
Few = Annotated[int, Field(ge=2, le=100)]
TAGS = 587  # of AprilTag's family 36h11


class Printed(Part):
    """A board, by the distance of its points."""

    unusual: bool = False  # a distance of points that no usual board has, such as below 0.5 mm, is meant

    @model_validator(mode="after")
    def _usual_step(self) -> Self:
        name = next(name for name in ("spacing_mm", "square_mm", "tag_mm") if name in type(self).model_fields)
        fault = BOARD_STEP.fault(getattr(self, name))
        if fault and not self.unusual:
            raise ValueError(f"{name}: expected {BOARD_STEP}, found {fault} If it is right, give unusual=true with it")
        return self


class AsymmetricCircles(Printed):
    """Discs in rows that stand half a step off each other."""

    kind: Literal["asymmetric_circles"] = "asymmetric_circles"
    columns: Few  # circles a row
    rows: Few
    spacing_mm: Positive  # between rows; circles of a row stand two spacings apart
    diameter_mm: Positive
    white: bool = False  # discs on a dark board, as metrology's are; else dark ones on a bright board

    def points(self) -> Array:
        """Centres of the discs : (columns * rows, 3) mm."""
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        return np.column_stack([2 * column + row % 2, row, np.zeros(row.size)]) * self.spacing_mm

    @property
    def rim_mm(self) -> float:
        """Breadth of what is printed beyond the outermost points."""
        return self.diameter_mm / 2


class SymmetricCircles(Printed):
    """Discs in a square grid. Half a turn maps it onto itself; the turn of each pose follows from the errors of the print."""

    kind: Literal["symmetric_circles"] = "symmetric_circles"
    columns: Few
    rows: Few
    spacing_mm: Positive
    diameter_mm: Positive
    white: bool = False  # as above

    def points(self) -> Array:
        """Centres of the discs : (columns * rows, 3) mm."""
        return _grid(self.columns, self.rows, self.spacing_mm)

    @property
    def rim_mm(self) -> float:
        """Breadth of what is printed beyond the outermost points."""
        return self.diameter_mm / 2


class Chessboard(Printed):
    """Black and white squares."""

    kind: Literal["chessboard"] = "chessboard"
    columns: Few  # inner corners a row: one less than squares
    rows: Few
    square_mm: Positive

    def points(self) -> Array:
        """Inner corners : (columns * rows, 3) mm."""
        return _grid(self.columns, self.rows, self.square_mm)

    @property
    def rim_mm(self) -> float:
        """Breadth of what is printed beyond the outermost points."""
        return self.square_mm


class Charuco(Printed):
    """A chessboard with ArUco markers in its white squares: each corner is known by itself, so a part of the board is enough."""

    kind: Literal["charuco"] = "charuco"
    columns: Annotated[int, Field(ge=3, le=100)]  # squares a row, as OpenCV counts them here
    rows: Annotated[int, Field(ge=3, le=100)]
    square_mm: Positive
    marker_mm: Positive
    dictionary: Annotated[str, Field(pattern="^DICT_")] = "DICT_5X5_100"  # OpenCV's name
    legacy: bool = False  # whether a marker stands in the first square, as OpenCV drew boards before 4.6

    @model_validator(mode="after")
    def _marker_fits(self) -> "Charuco":
        if self.marker_mm >= self.square_mm:
            raise ValueError(f"marker_mm: expected less than square_mm = {self.square_mm:g}, found {self.marker_mm:g}")
        return self

    def points(self) -> Array:
        """Inner corners : ((columns - 1) * (rows - 1), 3) mm, relative to the first."""
        return _grid(self.columns - 1, self.rows - 1, self.square_mm)

    @property
    def rim_mm(self) -> float:
        """Breadth of what is printed beyond the outermost points."""
        return self.square_mm


class AprilGrid(Printed):
    """Kalibr's grid of AprilTags 36h11, black squares between their corners: each corner is known by itself, as of `Charuco`.

    Tags are numbered row by row from the lower left one, 0, as Kalibr prints them.
    """

    kind: Literal["aprilgrid"] = "aprilgrid"
    columns: Annotated[int, Field(ge=1, le=100)]  # tags a row: Kalibr's tagCols
    rows: Annotated[int, Field(ge=1, le=100)]  # tagRows
    tag_mm: Positive  # side of a tag, its black border included: tagSize
    spacing_ratio: Annotated[float, Field(gt=0, le=1)] = 0.3  # gap between two tags over tag_mm: tagSpacing
    border_cells: Annotated[int, Field(ge=1, le=2)] = 2  # breadth of a tag's black border; Kalibr's is 2, AprilTag's own 1

    @model_validator(mode="after")
    def _few_enough(self) -> "AprilGrid":
        if self.columns * self.rows > TAGS:
            raise ValueError(f"rows: expected {TAGS} tags in all at most, as 36h11 has, found {self.columns} x {self.rows}")
        return self

    @property
    def rim_mm(self) -> float:
        """Breadth of what is printed beyond the outermost points: a gap, with its black squares."""
        return self.spacing_ratio * self.tag_mm

    def points(self) -> Array:
        """Corners of the tags : (4 * columns * rows, 3) mm, row by row, two of each tag in a row."""
        along, down = (_ends(count, self.tag_mm, self.spacing_ratio) for count in (self.columns, self.rows))
        y, x = np.meshgrid(down, along, indexing="ij")
        return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])

    def corners_of_tags(self) -> NDArray[np.intp]:
        """Which points are each tag's corners : (columns * rows, 4), from its upper left one clockwise, by the tags' numbers."""
        tag = np.arange(self.columns * self.rows)
        row, column = self.rows - 1 - tag // self.columns, tag % self.columns
        first = 4 * row * self.columns + 2 * column
        return first[:, None] + np.array([0, 1, 2 * self.columns + 1, 2 * self.columns])


BOARDS = (AsymmetricCircles, SymmetricCircles, Chessboard, Charuco, AprilGrid)
Circles = AsymmetricCircles | SymmetricCircles
Squares = Chessboard | Charuco | AprilGrid
Board = Annotated[AsymmetricCircles | SymmetricCircles | Chessboard | Charuco | AprilGrid, Field(discriminator="kind")]


def _grid(columns: int, rows: int, step: float) -> Array:
    row, column = np.divmod(np.arange(rows * columns), columns)
    return np.column_stack([column, row, np.zeros(row.size)]) * step


def _ends(count: int, side: float, ratio: float) -> Array:
    """Both ends of sides in a row with gaps between them : (2 * count,)."""
    return (np.arange(count)[:, None] * side * (1 + ratio) + np.array([0, side])).ravel()
