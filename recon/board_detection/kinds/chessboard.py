"""A chessboard."""

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.board_detection.checkerboard import (
    WINDOW,
    board_to_image,
    detection,
    eight_bits,
    moved,
    shortest_side,
)
from recon.board_detection.findings import BoardNotFound, Detection
from recon.board_detection.reduced_images import reduced
from recon.model.boards import Array, Board, Few, Shapes, grid
from recon.model.part import Positive

FEWEST_PX = 1.5e6  # pixels of a large image in which a chessboard is looked for first; see `reduced_images`
ALTERNATING = 0.3  # of the usual step from one square to the next: least one of a whole board
_CHESSBOARD = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY  # OpenCV 5 misses clean boards with CALIB_CB_NORMALIZE_IMAGE


class Chessboard(Board):
    """Black and white squares."""

    STEP = "square_mm"
    kind: Literal["chessboard"] = "chessboard"
    columns: Few  # inner corners a row: one less than squares
    rows: Few
    square_mm: Positive

    def points(self) -> Array:
        """Inner corners : (columns * rows, 3) mm."""
        return grid(self.columns, self.rows, self.square_mm)

    @property
    def rim_mm(self) -> float:
        """Breadth of what is printed beyond the outermost points."""
        return self.square_mm

    @property
    def half_turn_is_alike(self) -> bool:
        """Whether it looks the same after half a turn."""
        return (self.columns + self.rows) % 2 == 0

    def find(self, image: Array, full: float) -> Detection:
        """Find all inner corners of a chessboard; see `recon.board_detection.detect.detect`."""
        grey = eight_bits(image, full)
        looked = reduced(grey, FEWEST_PX)
        found, corners = cv2.findChessboardCornersSB(looked.image, (self.columns, self.rows), flags=_CHESSBOARD)
        if not found and looked.times > 1:
            closer = reduced(grey)
            found, corners = cv2.findChessboardCornersSB(closer.image, (self.columns, self.rows), flags=cv2.CALIB_CB_ACCURACY)
            looked = closer if found else looked
        if not found:
            small = f", looked for in {looked.image.shape[1]}x{looked.image.shape[0]} px" if looked.times > 1 else ""
            raise BoardNotFound(_why_no_chessboard(looked.image, self) + small)
        grid = _begun_rightly(looked.full(np.asarray(corners, float).reshape(self.rows, self.columns, 2)), grey)
        rough, points = grid.reshape(-1, 2), self.points()
        window = min(WINDOW[0] * shortest_side(rough, points, self.square_mm), WINDOW[1])
        return detection(image, rough, points, np.arange(len(points)), window, full)

    def shapes(self) -> Shapes:
        """What is printed."""
        return Shapes(np.zeros((0, 3)), _black_squares(self))


def _why_no_chessboard(grey: NDArray[np.uint8], board: Chessboard) -> str:
    flags = _CHESSBOARD | cv2.CALIB_CB_LARGER
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), flags)
    wanted = f"{board.columns} x {board.rows}"
    if not found or sorted(meta.shape) == sorted((board.columns, board.rows)):
        return f"found no chessboard of {wanted} inner corners"
    rows, columns = meta.shape
    larger = max(rows, columns) > max(board.columns, board.rows) or min(rows, columns) > min(board.columns, board.rows)
    if larger or _is_whole(np.asarray(corners, float).reshape(rows, columns, 2), grey):
        return f"found {columns} x {rows} inner corners instead of {wanted}: wrong board size"
    return f"found {columns} x {rows} of {wanted} inner corners"


def _is_whole(grid: Array, grey: NDArray[np.uint8]) -> bool:
    """Whether the squares about the corners : (rows, columns, 2) all lie in the image, dark and bright in turn."""
    rows, columns = grid.shape[:2]
    row, column = np.mgrid[:rows, :columns]
    homography = board_to_image(np.stack([column, row], axis=-1).reshape(-1, 2), grid.reshape(-1, 2))
    row, column = np.mgrid[: rows + 1, : columns + 1]  # of the squares
    at = np.rint(moved(homography, np.stack([column, row], axis=-1).reshape(-1, 2) - 0.5)).astype(int)
    if not ((at >= 0) & (at < grey.shape[::-1])).all():
        return False
    signed = grey[at[:, 1], at[:, 0]].reshape(row.shape) * np.where((row + column) % 2, 1.0, -1.0)
    steps = np.concatenate([(lines[1:] + lines[:-1]).ravel() for lines in (signed, signed.T)])  # from square to square
    usual = np.median(steps)
    return bool((steps * np.sign(usual) > ALTERNATING * abs(usual)).all())


def _begun_rightly(grid: Array, grey: NDArray[np.uint8]) -> Array:
    """The corners : (rows, columns, 2) in the order in which the view isn't mirrored and the square before the first is dark.

    Where that leaves a choice, the first is the one nearer to the image's upper left.
    """
    turned = [np.rot90(grid, k) for k in range(4)]
    ways = [way for way in turned + [way[:, ::-1] for way in turned] if way.shape == grid.shape and _handedness(way) > 0]
    dark = [way for way in ways if _begins_dark(way, grey)]
    return np.ascontiguousarray(min(dark or ways, key=lambda way: (way[0, 0].sum(), way[0, 0, 0])))


def _handedness(grid: Array) -> float:
    """Positive if x, y, z of the board are right-handed as seen from its front."""
    x, y = (grid[:, -1] - grid[:, 0]).mean(axis=0), (grid[-1] - grid[0]).mean(axis=0)
    return float(x[0] * y[1] - x[1] * y[0])


def _begins_dark(grid: Array, grey: NDArray[np.uint8]) -> bool:
    """Whether the square before the first corner is darker than the one beside it."""
    x, y = (grid[0, 1] - grid[0, 0]) / 2, (grid[1, 0] - grid[0, 0]) / 2
    before, beside = np.rint([grid[0, 0] - x - y, grid[0, 0] + x - y]).astype(int)
    before, beside = np.clip([before, beside], 0, np.array(grey.shape[::-1]) - 1)
    return bool(grey[before[1], before[0]] < grey[beside[1], beside[0]])


def _black_squares(board: Chessboard) -> Array:
    """Black squares : (n, 4) left, top, width, height in the board's frame; the first corner stands behind a black one."""
    row, column = np.indices((board.rows + 1, board.columns + 1)).reshape(2, -1)
    black = (row + column) % 2 == 0
    return board.square_mm * np.column_stack([column[black] - 1, row[black] - 1, np.ones((black.sum(), 2))])


Kind = Chessboard
