"""Kalibr's grid of AprilTags."""

from typing import Annotated, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.optimize import minimize_scalar

from recon.board_detection.checkerboard import (
    LEAST_CORNERS,
    LEAST_MARKERS,
    LEAST_WINDOW,
    MARGIN,
    WINDOW,
    astray,
    detected,
    detection,
    eight_bits,
    shortest_side,
)
from recon.board_detection.findings import MIRRORED, BoardNotFound, Detection
from recon.board_detection.reduced_images import LARGE_PX, reduced
from recon.model.boards import Array, Board, Shapes
from recon.model.part import Positive

TAG_FAMILY, TAGS = cv2.aruco.DICT_APRILTAG_36h11, 587  # and number of its tags
TAGS_ASTRAY = 1.0  # of a tag, RMS about where the board has them: a wide lens gives 0.3, a wrong number of columns 20 and more
RATIOS, WRONG_RATIO = (0.02, 1.0), 0.02  # of gaps to tags, and what isn't an error of corners
SHRUNK = (1, 3, 5)  # px: breadths of what is taken off dark areas, so that tags don't hang together by their corners


class AprilGrid(Board):
    """Kalibr's grid of AprilTags 36h11, black squares between their corners: each corner is known by itself, as of `Charuco`.

    Tags are numbered row by row from the lower left one, 0, as Kalibr prints them.
    """

    STEP = "tag_mm"
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

    @property
    def clear_mm(self) -> float:
        """Step of the pattern, of which a share is to be left clear around it."""
        return self.rim_mm

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

    @property
    def half_turn_is_alike(self) -> bool:
        """Whether it looks the same after half a turn."""
        return False

    def find(self, image: Array, full: float) -> Detection:
        """Find those corners of an AprilGrid that are in view; see `recon.board_detection.detect.detect`.

        OpenCV has each tag turned by half against AprilTag's own drawing and Kalibr's: its first corner is the lower right one.
        """
        grey = eight_bits(image, full)
        tags, numbers = _tags(grey, self.border_cells)
        if len(numbers) < min(LEAST_MARKERS, self.columns * self.rows):
            cells = 3 - self.border_cells
            others = {
                MIRRORED: (np.ascontiguousarray(grey[:, ::-1]), self.border_cells),
                f"tags have a border of {cells} cells: give the board border_cells: {cells}": (grey, cells),
            }
            for reason, (other, border) in others.items():
                if len(_tags(other, border)[1]) > 2 * len(numbers):
                    raise BoardNotFound(reason)
        if not len(numbers):
            raise BoardNotFound("found no tags of 36h11")
        places = self.corners_of_tags()
        known, several = numbers < len(places), f"{self.columns} x {self.rows}"
        if known.sum() <= len(known) / 2:
            raise BoardNotFound(f"tag {numbers[~known][0]} isn't on a grid of {several} tags: wrong board size")
        at, rough, points = places[numbers[known]].ravel(), tags[known].reshape(-1, 2), self.points()
        if not astray(points[at], rough, self.tag_mm) < TAGS_ASTRAY:
            turned = self.columns != self.rows and _fits_exchanged(tags[known], numbers[known], self)
            cause = "rows and columns exchanged?" if turned else "wrong columns, rows or spacing_ratio?"
            raise BoardNotFound(f"tags lie otherwise than on a grid of {several} tags: {cause}")
        cell = self.tag_mm / (6 + 2 * self.border_cells)
        clear = (
            MARGIN * min(np.sqrt(2) * self.border_cells * cell, self.rim_mm) / self.tag_mm
        )  # of a tag, to what isn't the corner's
        widest = WINDOW[1] * max(1.0, np.sqrt(image.size / LARGE_PX))  # tags were found in a reduced image, as roughly
        window = min(min(WINDOW[0], clear) * shortest_side(rough, points[at], self.tag_mm), widest)
        if window < LEAST_WINDOW:
            raise BoardNotFound(f"too small: {window:.1f} px between a corner and the cells of its tag")
        found = detection(image, rough, points, at, window, full)
        good = np.flatnonzero(np.isfinite(found.pixels).all(axis=1))
        if len(good) < LEAST_CORNERS:
            raise BoardNotFound(f"found {len(good)} corners, fewer than {LEAST_CORNERS}")
        _check_gaps(found.pixels[good], good, self)
        return found

    def shapes(self) -> Shapes:
        """What is printed."""
        return Shapes(np.zeros((0, 3)), _black_cells(self))


def _check_gaps(pixels: Array, at: NDArray[np.intp], board: AprilGrid) -> None:
    """Refuse a grid whose tags stand at other distances : pixels (n, 2) of the corners `at` (n,)."""

    def misfit(ratio: float) -> float:
        return astray(board.model_copy(update={"spacing_ratio": ratio}).points()[at], pixels, board.tag_mm)

    found = float(minimize_scalar(misfit, bounds=RATIOS, method="bounded").x)
    if abs(found - board.spacing_ratio) > WRONG_RATIO and misfit(found) < misfit(board.spacing_ratio) / 2:
        raise BoardNotFound(
            f"tags stand as with spacing_ratio {found:.2f}, not {board.spacing_ratio:g}: is that gap over tag_mm?"
        )


def _tags(grey: NDArray[np.uint8], border: int) -> tuple[Array, NDArray[np.int64]]:
    """Corners : (k, 4, 2) px, from the upper left one clockwise, and numbers : (k,) of AprilTags, each of them once."""
    settings = cv2.aruco.DetectorParameters()
    settings.markerBorderBits = border
    detector, looked = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(TAG_FAMILY), settings), reduced(grey)
    found: dict[int, Array] = {}
    for breadth in SHRUNK:
        apart = looked.image if breadth == 1 else cv2.dilate(looked.image, np.ones((breadth, breadth), np.uint8))
        for number, corners in zip(*reversed(detected(detector, apart)), strict=True):
            found.setdefault(int(number), looked.full(corners[[2, 3, 0, 1]]))
    return np.array(list(found.values())).reshape(-1, 4, 2), np.array(list(found), np.int64)


def _fits_exchanged(tags: Array, numbers: NDArray[np.int64], board: AprilGrid) -> bool:
    """Whether tags : (k, 4, 2) px lie as on a grid that has as many columns as this one has rows."""
    other = board.model_copy(update={"columns": board.rows, "rows": board.columns})
    at = other.corners_of_tags()[numbers].ravel()
    return astray(other.points()[at], tags.reshape(-1, 2), board.tag_mm) < TAGS_ASTRAY


def _ends(count: int, side: float, ratio: float) -> Array:
    """Both ends of sides in a row with gaps between them : (2 * count,)."""
    return (np.arange(count)[:, None] * side * (1 + ratio) + np.array([0, side])).ravel()


def _black_cells(board: AprilGrid) -> Array:
    """Black cells of the tags, and the squares that stand corner to corner with them, as of a chessboard."""
    family, gap, cells = cv2.aruco.getPredefinedDictionary(TAG_FAMILY), board.rim_mm, 6 + 2 * board.border_cells
    points, boxes, side = board.points()[:, :2], [], board.tag_mm / cells
    for number, corners in enumerate(board.corners_of_tags()):
        left, top = points[corners[0]]
        image = cv2.aruco.generateImageMarker(family, number, cells, borderBits=board.border_cells)[::-1, ::-1]  # as in `find`
        boxes += [[left + x * side, top + y * side, side, side] for y, x in np.argwhere(image == 0)]
    ends = [np.unique(points[:, axis]) for axis in range(2)]
    x, y = ([line[0] - gap, *line[1::2]] for line in ends)  # where gaps begin
    boxes += [[left, top, gap, gap] for left in x for top in y]
    return np.array(boxes)


Kind = AprilGrid
