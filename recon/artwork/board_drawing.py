"""Calibration boards as cards to print: what `recon.model.boards` describes, with the quiet border that detectors need."""

import numpy as np

from recon.artwork.paper_sheet import CAPTION_MM, Array, Card, Ink, Size
from recon.model.boards import Board, Discs

QUIET = 0.4  # of a step of the pattern, clear around it
CAPTION_BAND_MM = CAPTION_MM + 2.2


def card_of(board: Board) -> Card:
    """Draw a board, upright: its first point is above, at the left."""
    low, high = _extent(board)
    least_quiet_mm = 6.0
    quiet = max(QUIET * board.clear_mm, least_quiet_mm)
    size = (float(high[0] - low[0]) + 2 * quiet, float(high[1] - low[1]) + 2 * quiet)
    origin = np.array([quiet - low[0], CAPTION_BAND_MM + quiet + high[1]])  # of the board's frame, of which y runs down
    sized = (size[0], size[1] + CAPTION_BAND_MM)
    return Card(sized, _inks(board, origin, size), f"sonotwin  {in_words(board)}")


def in_words(board: Board) -> str:
    """A board's design on one line, such as `asymmetric_circles, 4 x 11, spacing 15 mm, diameter 9 mm`."""
    fields = board.model_dump(exclude={"kind", "columns", "rows"}, exclude_defaults=True)
    others = [_other(name, value) for name, value in fields.items() if not name.endswith("_mm")]
    said = [text for name in board.SAID if (text := str(getattr(board, name))) not in others]
    return ", ".join([board.kind, f"{board.columns} x {board.rows}", lengths_in_words(board), *said, *others])


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


def _extent(board: Board) -> tuple[Array, Array]:
    """Corners of what is drawn in the board's frame, smallest and largest : (2,), (2,) mm."""
    points = board.points()[:, :2]
    return points.min(axis=0) - board.rim_mm, points.max(axis=0) + board.rim_mm


def _inks(board: Board, origin: Array, size: Size) -> tuple[Ink, ...]:
    """The shapes on a card, of which the pattern with its border has a size."""
    discs, boxes = board.shapes()
    discs = np.column_stack([origin + discs[:, :2] * [1, -1], discs[:, 2]])
    x, y, width, height = boxes.T
    boxes = np.column_stack([origin[0] + x, origin[1] - y - height, width, height])
    if isinstance(board, Discs) and board.white:
        return Ink(False, boxes=np.array([[0.0, CAPTION_BAND_MM, *size]])), Ink(True, discs)
    return (Ink(False, discs, boxes),)
