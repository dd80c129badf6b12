"""Calibration boards by their design: which points they carry, in which order, and where these lie.

Board frame: x to the right, y down, z away from the viewer, origin at the first point. Points come in OpenCV's order, row by row.
"""

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from recon.model.lengths import BOARD_STEP
from recon.model.part import Kinds, Positive

Array = NDArray[np.float64]
Few = Annotated[int, Field(ge=2, le=100)]


class Shapes(NamedTuple):
    """What is printed in black, in the board's frame, mm; in white on black if the board says so."""

    discs: Array  # (n, 3) x, y, radius
    boxes: Array  # (m, 4) left, top, width, height


class Board(Kinds):
    """A calibration board, by the distance of its points; its kinds are modules of `recon.board_detection.kinds`."""

    PACKAGE = "recon.board_detection.kinds"
    STEP: ClassVar[str]  # name of the field of the distance from point to point
    SAID: ClassVar[tuple[str, ...]] = ()  # fields that its caption has, also if they are as usual

    if TYPE_CHECKING:  # fields and functions of each kind
        columns: int
        rows: int

        @property
        def rim_mm(self) -> float:
            """Breadth of what is printed beyond the outermost points."""

        @property
        def half_turn_is_alike(self) -> bool:
            """Whether it looks the same after half a turn."""

        def points(self) -> Array:
            """Its points : (n, 3) mm."""

        def shapes(self) -> Shapes:
            """What is printed."""

        def find(self, image: NDArray[np.float32], full: float) -> Any:
            """Its points in an image, as of `recon.board_detection.detect.detect`."""

    unusual: bool = False  # a distance of points that no usual board has, such as below 0.5 mm, is meant

    @model_validator(mode="after")
    def _usual_step(self) -> Self:
        fault = BOARD_STEP.fault(self.step_mm)
        if fault and not self.unusual:
            raise ValueError(f"{self.STEP}: expected {BOARD_STEP}, found {fault} If it is right, give unusual=true with it")
        return self

    @property
    def step_mm(self) -> float:
        """Distance from point to point, as its field has it."""
        return getattr(self, self.STEP)

    @property
    def clear_mm(self) -> float:
        """Step of the pattern, of which a share is to be left clear around it."""
        return self.step_mm


class Discs(Board):
    """A board of discs, in rows."""

    STEP = "spacing_mm"
    NEIGHBOURS: ClassVar[tuple[tuple[int, int], tuple[int, int]]]  # steps, in spacings, to two of a disc's neighbours

    kind: str
    columns: Few  # circles a row
    rows: Few
    spacing_mm: Positive
    diameter_mm: Positive
    white: bool = False  # discs on a dark board, as metrology's are; else dark ones on a bright board

    @property
    def rim_mm(self) -> float:
        """Breadth of what is printed beyond the outermost points."""
        return self.diameter_mm / 2

    @property
    def pitch_mm(self) -> float:
        """Distance of a disc from the nearest."""
        return self.spacing_mm * float(np.hypot(*self.NEIGHBOURS[0]))

    def shapes(self) -> Shapes:
        """What is printed."""
        centres = self.points()[:, :2]
        return Shapes(np.column_stack([centres, np.full(len(centres), self.diameter_mm / 2)]), np.zeros((0, 4)))


def grid(columns: int, rows: int, step: float) -> Array:
    """Points of a square grid : (columns * rows, 3) mm, row by row."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    return np.column_stack([column, row, np.zeros(row.size)]) * step
