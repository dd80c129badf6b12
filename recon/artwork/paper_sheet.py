"""Sheets for a printer as vector PDF: on each a card to cut out, true to scale, cut marks, a ruler along each axis, small print.

Lengths are mm; the origin is the lower left corner, of the card or of the paper, y upwards.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from reportlab.lib.utils import simpleSplit
from reportlab.pdfgen.canvas import Canvas

Array = NDArray[np.float64]
Size = tuple[float, float]  # width, height, mm

MARK = b"% sonotwin sha256 "  # of all before it, by which a sheet as it was written is known
PAPERS: dict[str, Size] = {  # upright, the smallest first
    "a4": (210.0, 297.0),
    "letter": (215.9, 279.4),
    "a3": (297.0, 420.0),
    "tabloid": (279.4, 431.8),
    "a2": (420.0, 594.0),
    "a1": (594.0, 841.0),
    "a0": (841.0, 1189.0),
}
RULER_MM = 100.0
LEFT_MM = 10.0  # beside the card, for the upright ruler
BELOW_MM = 17.0  # below the card, for the other ruler and the small print beside it
FONT, BOLD, FONT_MM = "Helvetica", "Helvetica-Bold", 2.2  # 6.2 points
CAPTION_MM = 1.8  # height of the letters on the card


class Ink(NamedTuple):
    """Shapes of one colour; those that touch have no seam between them."""

    white: bool
    discs: Array = np.empty((0, 3))  # (n, 3) centre x, y and radius, mm
    boxes: Array = np.empty((0, 4))  # (n, 4) left, bottom, width, height, mm


@dataclass(frozen=True)
class Card:
    """What is cut out of the sheet."""

    size: Size
    inks: tuple[Ink, ...]  # the later ones cover the earlier ones
    caption: str = ""  # in small letters along the lower edge, where it is drawn `CAPTION_MM` high


class Sheet(NamedTuple):
    """Where all lies on the paper."""

    paper: Size  # as the card stands upright on it
    card: Size  # lower left corner of the card


class Page(NamedTuple):
    """A card on its sheet, and the small print, of which the first line is bold."""

    card: Card
    sheet: Sheet
    lines: Sequence[str]


def needed(card: Size, margin_mm: float) -> Size:
    """Size of the paper that a card of a size needs, with rulers, marks and a margin on which no printer prints."""
    marks_mm = 5.0  # around the card, for the cut marks
    print_mm = 80.0  # width of the small print, at least
    width = max(card[0] + 2 * marks_mm, RULER_MM + print_mm)
    return 2 * margin_mm + LEFT_MM + width, 2 * margin_mm + BELOW_MM + max(card[1] + 2 * marks_mm, RULER_MM)


def lay_out(card: Size, paper: Size, margin_mm: float) -> Sheet | None:
    """Place a card on paper, as that is given or else turned, amid the room that the rulers leave; None if it doesn't fit."""
    width, height = needed(card, margin_mm)
    for wide, high in (paper, paper[::-1]):
        if width <= wide and height <= high:
            left, below = margin_mm + LEFT_MM, margin_mm + BELOW_MM
            return Sheet((wide, high), ((left + wide - margin_mm - card[0]) / 2, (below + high - margin_mm - card[1]) / 2))
    return None


def smallest_paper(card: Size, margin_mm: float) -> str | None:
    """Name of the smallest usual paper on which a card fits."""
    return next((name for name, paper in PAPERS.items() if lay_out(card, paper, margin_mm)), None)


def write(path: Path, pages: Sequence[Page], margin_mm: float, title: str) -> None:
    """Write sheets as PDF, a page each; the same input gives the same bytes."""
    point_mm, hairline_mm = 25.4 / 72, 0.1  # PDF's unit
    canvas = Canvas(str(path), invariant=1)
    canvas.setTitle(title)
    canvas.setCreator("sonotwin")
    canvas.setViewerPreference("PrintScaling", "None")  # so that viewers offer 100 % first
    left = margin_mm + LEFT_MM + RULER_MM + 8
    for card, sheet, lines in pages:
        canvas.setPageSize((sheet.paper[0] / point_mm, sheet.paper[1] / point_mm))
        canvas.scale(1 / point_mm, 1 / point_mm)
        canvas.setLineWidth(hairline_mm)
        _draw_card(canvas, card, sheet.card)
        _draw_marks(canvas, card.size, sheet.card)
        _draw_rulers(canvas, (margin_mm + LEFT_MM, margin_mm + BELOW_MM))
        _write_lines(canvas, lines, (left, margin_mm + BELOW_MM - 3.5), sheet.paper[0] - margin_mm - left)
        canvas.showPage()
    canvas.save()
    mark(path)


def mark(path: Path) -> None:
    """Mark a PDF as it was written."""
    content = path.read_bytes()
    path.write_bytes(content + _mark_of(content))


def is_sheet(path: Path) -> bool:
    """Whether a file is a sheet as `write` wrote it: one with a note or a signature added is somebody else's."""
    content, begins, _ = path.read_bytes().rpartition(MARK)
    return bool(begins) and path.read_bytes() == content + _mark_of(content)


def _mark_of(content: bytes) -> bytes:
    """A comment after the end of a PDF."""
    return MARK + hashlib.sha256(content).hexdigest().encode("ascii") + b"\n"


def _draw_card(canvas: Canvas, card: Card, at: Size) -> None:
    canvas.saveState()
    canvas.translate(*at)
    for ink in card.inks:
        canvas.setFillGray(float(ink.white))
        path = canvas.beginPath()  # one for all: apart, shapes that touch would leave hairlines between them
        for left, bottom, width, height in ink.boxes.tolist():
            path.rect(left, bottom, width, height)
        for x, y, radius in ink.discs.tolist():
            path.circle(x, y, radius)  # of four cubic arcs, round to 0.03 % of the radius
        canvas.drawPath(path, stroke=0, fill=1)
    canvas.setFillGray(0)
    canvas.setFont(FONT, CAPTION_MM)
    canvas.drawString(2, 1.2, card.caption)
    canvas.restoreState()


def _draw_marks(canvas: Canvas, size: Size, at: Size) -> None:
    mark_gap_mm, mark_mm = 1.0, 4.0  # from the card to a mark, and its length
    for x, way_x in ((at[0], -1), (at[0] + size[0], 1)):
        for y, way_y in ((at[1], -1), (at[1] + size[1], 1)):
            canvas.line(x + mark_gap_mm * way_x, y, x + (mark_gap_mm + mark_mm) * way_x, y)
            canvas.line(x, y + mark_gap_mm * way_y, x, y + (mark_gap_mm + mark_mm) * way_y)


def _draw_rulers(canvas: Canvas, corner: Size) -> None:
    """One to the right of the corner and one upwards, with their ticks away from the card."""
    for turn, way in ((0, -1), (90, 1)):
        canvas.saveState()
        canvas.translate(*corner)
        canvas.rotate(turn)
        _draw_ruler(canvas, way)
        canvas.restoreState()


def _draw_ruler(canvas: Canvas, way: int) -> None:
    """A ruler along x that measures from the middle of its first line to that of its last, ticks and letters to y times `way`."""
    start = 2.0 * way
    canvas.line(0, start, RULER_MM, start)
    for mm in range(int(RULER_MM) + 1):
        canvas.line(mm, start, mm, start + way * (3.0 if mm % 10 == 0 else 2.2 if mm % 5 == 0 else 1.4))
    beyond = FONT_MM * 0.72 if way < 0 else 0.0  # letters hang from below their line
    canvas.setFont(FONT, FONT_MM)
    for mm in range(0, int(RULER_MM) + 1, 10):
        canvas.drawCentredString(mm, start + way * 3.6 - beyond, str(mm))
    canvas.setFont(BOLD, FONT_MM)
    ruler_text = "print at 100 %; this must be 100.0 mm"
    canvas.drawCentredString(RULER_MM / 2, start + way * 6.2 - beyond, ruler_text)


def _write_lines(canvas: Canvas, lines: Sequence[str], at: Size, width: float) -> None:
    """Small print from a point downwards, the first line bold."""
    x, y = at
    leading_mm = 2.7
    for font, line in zip((BOLD, *[FONT] * len(lines)), lines, strict=False):
        canvas.setFont(font, FONT_MM)
        for part in simpleSplit(line, font, FONT_MM, width):
            canvas.drawString(x, y, part)
            y -= leading_mm
