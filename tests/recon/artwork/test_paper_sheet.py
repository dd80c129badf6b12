"""The sheet around a card: rulers of 100 mm, nothing on the printer's margin, and the same bytes each time."""

import numpy as np
import pytest

from recon.artwork import board_drawing, paper_sheet
from recon.artwork.paper_sheet import PAPERS
from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.board_detection.kinds.chessboard import Chessboard
from tests.recon.artwork.rasters import raster

MARGIN = 5.0
CARD = board_drawing.card_of(AsymmetricCircles(columns=4, rows=11, spacing_mm=15, diameter_mm=9))
LINES = ["Print at 100 %", "a line of small print that is long enough to be broken on upright paper, " * 3]


def drawn(path, card=CARD, paper="a4"):
    sheet = paper_sheet.lay_out(card.size, PAPERS[paper], MARGIN)
    paper_sheet.write(path, [paper_sheet.Page(card, sheet, LINES)], MARGIN, "a board")
    return sheet


def test_rulers_measure_a_hundred_millimetres(tmp_path):
    """From the first long line to the last, along both axes, to 0.02 mm."""
    drawn(tmp_path / "a.pdf")
    image, pixel = raster(tmp_path / "a.pdf", 300)
    height, ink = image.shape[0], image.max() - image.astype(float)
    corner = np.array([MARGIN + paper_sheet.LEFT_MM, MARGIN + paper_sheet.BELOW_MM])
    row = height - (corner[1] - 4.7) / pixel[1]  # across the long lines, beyond the shorter ones
    column = (corner[0] - 4.7) / pixel[0]
    across, down = ink[int(row) - 1 : int(row) + 2].mean(axis=0), ink[:, int(column) - 1 : int(column) + 2].mean(axis=1)[::-1]
    for profile, start, step in ((across, corner[0], pixel[0]), (down, corner[1], pixel[1])):
        at = np.arange(len(profile)) * step
        places = [
            np.average(at[near], weights=profile[near]) for x in range(11) if (near := np.abs(at - start - 10 * x) < 0.4).any()
        ]
        assert np.diff(places) == pytest.approx(10, abs=0.02)
        assert places[-1] - places[0] == pytest.approx(100, abs=0.02)


@pytest.mark.parametrize("paper", ["a4", "letter", "a3"])
def test_nothing_is_printed_on_the_margin(paper, tmp_path):
    drawn(tmp_path / "a.pdf", paper=paper)
    image, pixel = raster(tmp_path / "a.pdf", 100)
    x, y = np.floor(MARGIN / pixel).astype(int) - 1
    inside = image[y:-y, x:-x]
    assert (image == image.max()).sum() - (inside == image.max()).sum() == image.size - inside.size


def test_a_card_is_turned_or_refused_where_it_does_not_fit():
    wide = board_drawing.card_of(Chessboard(columns=9, rows=6, square_mm=25)).size
    assert paper_sheet.lay_out(wide, PAPERS["a4"], MARGIN) is None
    assert paper_sheet.smallest_paper(wide, MARGIN) == "a3"
    fits = board_drawing.card_of(Chessboard(columns=10, rows=5, square_mm=21)).size
    sheet = paper_sheet.lay_out(fits, PAPERS["a4"], MARGIN)
    assert sheet.paper == (297.0, 210.0)
    assert sheet.card[0] - MARGIN >= paper_sheet.LEFT_MM and sheet.card[1] - MARGIN >= paper_sheet.BELOW_MM
    assert sheet.card[0] + fits[0] <= 297 - MARGIN and sheet.card[1] + fits[1] <= 210 - MARGIN


def test_the_same_bytes_each_time(tmp_path):
    drawn(tmp_path / "a.pdf")
    drawn(tmp_path / "b.pdf")
    assert (tmp_path / "a.pdf").read_bytes() == (tmp_path / "b.pdf").read_bytes()
