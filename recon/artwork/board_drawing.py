"""Calibration boards as cards to print: what `recon.model.boards` describes, with the quiet border that detectors need."""

import cv2
import numpy as np

from recon.artwork.paper_sheet import CAPTION_MM, Array, Card, Ink, Size
from recon.board_detection.checkerboard import TAG_FAMILY, charuco_of
from recon.model.boards import AprilGrid, Board, Charuco, Chessboard, Squares

QUIET = 0.4  # of a step of the pattern, clear around it
CAPTION_BAND_MM = CAPTION_MM + 2.2


def card_of(board: Board) -> Card:
    """Draw a board, upright: its first point is above, at the left."""
    low, high = _extent(board)
    least_quiet_mm = 6.0
    quiet = max(QUIET * _step(board), least_quiet_mm)
    size = (float(high[0] - low[0]) + 2 * quiet, float(high[1] - low[1]) + 2 * quiet)
    origin = np.array([quiet - low[0], CAPTION_BAND_MM + quiet + high[1]])  # of the board's frame, of which y runs down
    sized = (size[0], size[1] + CAPTION_BAND_MM)
    return Card(sized, _inks(board, origin, size), f"sonotwin  {in_words(board)}")


def in_words(board: Board) -> str:
    """A board's design on one line, such as `asymmetric_circles, 4 x 11, spacing 15 mm, diameter 9 mm`."""
    fields = board.model_dump(exclude={"kind", "columns", "rows"}, exclude_defaults=True)
    others = [_other(name, value) for name, value in fields.items() if not name.endswith("_mm")]
    dictionary = [board.dictionary] if isinstance(board, Charuco) and board.dictionary not in others else []
    return ", ".join([board.kind, f"{board.columns} x {board.rows}", lengths_in_words(board), *dictionary, *others])


def _other(name: str, value: object) -> str:
    return name if value is True else value if isinstance(value, str) else f"{name} {_plain(value)}"


def lengths_in_words(board: Board) -> str:
    """A board's lengths on one line, such as `spacing 15 mm, diameter 9 mm`."""
    fields = board.model_dump(exclude_defaults=True)
    return ", ".join(f"{name.removesuffix('_mm')} {value:g} mm" for name, value in fields.items() if name.endswith("_mm"))


def as_field(board: Board) -> str:
    """A board as the field `board` of verbs has it, such as `{kind: chessboard, columns: 9, rows: 6, square_mm: 25}`."""
    fields = {"kind": board.kind} | board.model_dump(exclude_defaults=True)
    return "{" + ", ".join(f"{name}: {_plain(value)}" for name, value in fields.items()) + "}"


def scaled(board: Board, factor: float) -> Board:
    """A board with all its lengths times a factor, cut to tenths of a mm."""
    lengths = {name: value for name, value in board.model_dump().items() if name.endswith("_mm")}
    return board.model_copy(update={name: np.floor(10 * factor * value + 1e-9) / 10 for name, value in lengths.items()})


def _plain(value: object) -> str:
    return f"{value:.10g}" if isinstance(value, float) else str(value).lower() if isinstance(value, bool) else str(value)


def _step(board: Board) -> float:
    if isinstance(board, AprilGrid):
        return board.rim_mm
    return board.square_mm if isinstance(board, Chessboard | Charuco) else board.spacing_mm


def _extent(board: Board) -> tuple[Array, Array]:
    """Corners of what is drawn in the board's frame, smallest and largest : (2,), (2,) mm."""
    points = board.points()[:, :2]
    return points.min(axis=0) - board.rim_mm, points.max(axis=0) + board.rim_mm


def _inks(board: Board, origin: Array, size: Size) -> tuple[Ink, ...]:
    """The shapes on a card, of which the pattern with its border has a size."""
    if isinstance(board, Squares):
        if isinstance(board, AprilGrid):
            corners = _aprilgrid(board)
        else:
            corners = _chessboard(board) if isinstance(board, Chessboard) else _charuco(board)
        x, y, width, height = corners.T
        return (Ink(False, boxes=np.column_stack([origin[0] + x, origin[1] - y - height, width, height])),)
    centres = origin + board.points()[:, :2] * [1, -1]
    discs = np.column_stack([centres, np.full(len(centres), board.diameter_mm / 2)])
    if board.white:
        return Ink(False, boxes=np.array([[0.0, CAPTION_BAND_MM, *size]])), Ink(True, discs)
    return (Ink(False, discs),)


def _chessboard(board: Chessboard) -> Array:
    """Black squares : (n, 4) left, top, width, height in the board's frame; the first corner stands behind a black one."""
    row, column = np.indices((board.rows + 1, board.columns + 1)).reshape(2, -1)
    black = (row + column) % 2 == 0
    return board.square_mm * np.column_stack([column[black] - 1, row[black] - 1, np.ones((black.sum(), 2))])


def _charuco(board: Charuco) -> Array:
    """Black squares, and black cells of the markers in the white ones, as `_chessboard` has them."""
    design = charuco_of(board)
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


def _aprilgrid(board: AprilGrid) -> Array:
    """Black cells of the tags, and the squares that stand corner to corner with them, as `_chessboard` has them."""
    family, gap, cells = cv2.aruco.getPredefinedDictionary(TAG_FAMILY), board.rim_mm, 6 + 2 * board.border_cells
    points, boxes, side = board.points()[:, :2], [], board.tag_mm / cells
    for number, corners in enumerate(board.corners_of_tags()):
        left, top = points[corners[0]]
        image = cv2.aruco.generateImageMarker(family, number, cells, borderBits=board.border_cells)[
            ::-1, ::-1
        ]  # see `find_aprilgrid`
        boxes += [[left + x * side, top + y * side, side, side] for y, x in np.argwhere(image == 0)]
    ends = [np.unique(points[:, axis]) for axis in range(2)]
    x, y = ([line[0] - gap, *line[1::2]] for line in ends)  # where gaps begin
    boxes += [[left, top, gap, gap] for left in x for top in y]
    return np.array(boxes)
