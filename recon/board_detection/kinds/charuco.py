"""A chessboard with ArUco markers, a ChArUco board."""

from typing import Annotated, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

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
from recon.errors import InputError
from recon.model.boards import Array, Board, Shapes, grid
from recon.model.part import Positive

LEAST_SPREAD = 0.5  # of a square: smaller singular value of corners that tell a homography, whichever one is left out
ASTRAY = 0.25  # of a square, RMS of markers about where the board has them


class Charuco(Board):
    """A chessboard with ArUco markers in its white squares: each corner is known by itself, so a part of the board is enough."""

    STEP, SAID = "square_mm", ("dictionary",)
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
        return grid(self.columns - 1, self.rows - 1, self.square_mm)

    @property
    def rim_mm(self) -> float:
        """Breadth of what is printed beyond the outermost points."""
        return self.square_mm

    @property
    def half_turn_is_alike(self) -> bool:
        """Whether it looks the same after half a turn."""
        return False

    def find(self, image: Array, full: float) -> Detection:
        """Find those inner corners of a ChArUco board that are in view; see `recon.board_detection.detect.detect`."""
        grey = eight_bits(image, full)
        design = _design(self)
        markers, numbers = _markers(grey, design)
        if len(numbers) < LEAST_MARKERS and len(_markers(np.ascontiguousarray(grey[:, ::-1]), design)[1]) >= LEAST_MARKERS:
            raise BoardNotFound(MIRRORED)
        if not len(numbers):
            raise BoardNotFound(f"found no markers of {self.dictionary}")
        _check_markers(markers, numbers, design, self)
        corners, ids = cv2.aruco.CharucoDetector(design).detectBoard(grey)[:2]
        count = 0 if ids is None else len(ids)
        if count < LEAST_CORNERS:
            raise BoardNotFound(f"found {count} corners beside {len(numbers)} markers, fewer than {LEAST_CORNERS}")
        rough, at = np.asarray(corners, float).reshape(-1, 2), np.asarray(ids).ravel()
        points = self.points()
        if _on_one_line(points[at], self.square_mm):
            raise BoardNotFound("corners all on one line, but for one at most")
        side = shortest_side(rough, points[at], self.square_mm)
        clear = MARGIN * (self.square_mm - self.marker_mm) / np.sqrt(2) / self.square_mm  # of a square, to the nearest marker
        window = min(min(WINDOW[0], clear) * side, WINDOW[1])
        if window < LEAST_WINDOW:
            raise BoardNotFound(f"too small: {window:.1f} px between corners and markers")
        return detection(image, rough, points, at, window, full)

    def shapes(self) -> Shapes:
        """What is printed."""
        return Shapes(np.zeros((0, 3)), _black_cells(self))


def _on_one_line(points: Array, square_mm: float) -> bool:
    """Whether all corners but one lie on a line, or all of them: no homography follows from these."""
    planar = points[:, :2] / square_mm
    rests = (np.delete(planar, k, axis=0) for k in range(len(planar)))
    return min(np.linalg.svd(rest - rest.mean(axis=0), compute_uv=False)[1] for rest in rests) < LEAST_SPREAD


def _design(board: Charuco) -> cv2.aruco.CharucoBoard:
    """OpenCV's board of a design; raises InputError if its dictionary is unknown, or has too few markers."""
    number = getattr(cv2.aruco, board.dictionary, None)
    if not isinstance(number, int):
        raise InputError(f"dictionary: expected one of OpenCV's, such as DICT_5X5_100, found {board.dictionary!r}")
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    needed, there = board.columns * board.rows // 2, len(dictionary.bytesList)
    if needed > there:
        raise InputError(
            f"dictionary: expected at least {needed} markers for so many squares, found {there} in {board.dictionary}"
        )
    design = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_mm, board.marker_mm, dictionary)
    design.setLegacyPattern(board.legacy)
    return design


def _markers(grey: NDArray[np.uint8], design: cv2.aruco.CharucoBoard) -> tuple[Array, NDArray[np.int64]]:
    """Corners : (k, 4, 2) px and numbers : (k,) of the markers in view."""
    return detected(cv2.aruco.ArucoDetector(design.getDictionary()), grey)


def _check_markers(markers: Array, numbers: NDArray[np.int64], design: cv2.aruco.CharucoBoard, board: Charuco) -> None:
    """Refuse a board with other markers, or with these in other places."""
    ids = np.asarray(design.getIds()).ravel().tolist()
    places = dict(zip(ids, np.asarray(design.getObjPoints(), float), strict=True))
    known = np.array([int(number) in places for number in numbers])
    if known.sum() <= len(known) / 2:
        raise BoardNotFound(
            f"marker {numbers[~known][0]} isn't on a board of {board.columns} x {board.rows} squares: wrong board size"
        )
    points = np.concatenate([places[int(number)] for number in numbers[known]])
    pixels = markers[known].reshape(-1, 2)
    if not astray(points, pixels, board.square_mm) < ASTRAY:
        raise BoardNotFound(f"markers lie otherwise than on the board: {_likely_charuco(markers[known], numbers[known], board)}")


def _likely_charuco(markers: Array, numbers: NDArray[np.int64], board: Charuco) -> str:
    """The fields of a board on which markers : (k, 4, 2) px lie as they do here, in words."""
    exchanged, other = {"columns": board.rows, "rows": board.columns}, not board.legacy
    which, field = "older" if other else "newer", f"legacy: {str(other).lower()}"
    for update, words in (
        ({"legacy": other}, f"its pattern is OpenCV's {which} one: give the board {field}"),
        (exchanged, "rows and columns exchanged?"),
        (exchanged | {"legacy": other}, f"rows and columns exchanged, and {field}?"),
    ):
        places = _design(board.model_copy(update=update)).getObjPoints()
        points = np.concatenate([np.asarray(places[int(number)], float) for number in numbers])
        if astray(points, markers.reshape(-1, 2), board.square_mm) < ASTRAY:
            return words
    return "wrong board size?"


def _black_cells(board: Charuco) -> Array:
    """Black squares, and black cells of the markers in the white ones, as of a chessboard."""
    design = _design(board)
    places = np.asarray(design.getObjPoints(), float)[:, 0, :2]  # upper left corners, from the board's own
    taken = {(int(y), int(x)) for x, y in np.floor(places / board.square_mm)}
    squares = [(y, x) for y, x in np.ndindex(board.rows, board.columns) if (y, x) not in taken]
    boxes = [[x, y, 1, 1] * np.array(board.square_mm) for y, x in squares]
    dictionary = design.getDictionary()
    cells = dictionary.markerSize + 2  # with its border
    side = board.marker_mm / cells
    for number, (left, top) in zip(np.ravel(design.getIds()).tolist(), places, strict=True):
        image = cv2.aruco.generateImageMarker(dictionary, number, cells)
        boxes += [[left + x * side, top + y * side, side, side] for y, x in np.argwhere(image == 0)]
    return np.array(boxes) - [board.square_mm, board.square_mm, 0, 0]


Kind = Charuco
