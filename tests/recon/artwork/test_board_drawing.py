"""Boards on paper, as our own detectors find them in the sheet at a printer's resolution."""

import cv2
import numpy as np
import pytest

from recon.artwork import board_drawing, paper_sheet
from recon.board_detection.detect import detect
from recon.board_detection.kinds.aprilgrid import AprilGrid
from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.board_detection.kinds.charuco import Charuco
from recon.board_detection.kinds.chessboard import Chessboard
from recon.board_detection.kinds.symmetric_circles import SymmetricCircles
from tests.recon.artwork.rasters import raster, rigid_misfit

A4 = paper_sheet.PAPERS["a4"]
MARGIN = 5.0
BOARDS = {
    "asymmetric": AsymmetricCircles(columns=4, rows=11, spacing_mm=15, diameter_mm=9),
    "asymmetric_white": AsymmetricCircles(columns=4, rows=11, spacing_mm=15, diameter_mm=9, white=True),
    "symmetric": SymmetricCircles(columns=7, rows=5, spacing_mm=20, diameter_mm=10),
    "chessboard": Chessboard(columns=8, rows=5, square_mm=20),
    "charuco": Charuco(columns=8, rows=11, square_mm=20, marker_mm=15),
    "charuco_legacy": Charuco(columns=7, rows=10, square_mm=20, marker_mm=14, dictionary="DICT_4X4_50", legacy=True),
    "aprilgrid": AprilGrid(columns=4, rows=5, tag_mm=30),
}


def sheet_of(board, path):
    """Write the board's sheet on A4; returns the place of its first point on the raster : (2,) mm from the upper left."""
    card = board_drawing.card_of(board)
    sheet = paper_sheet.lay_out(card.size, A4, MARGIN)
    lines = ["in bold", board_drawing.in_words(board)]
    paper_sheet.write(path, [paper_sheet.Page(card, sheet, lines)], MARGIN, "board")
    return sheet


def check(board, path, dpi):
    """Spacing and diameter within 0.02 mm, upright, all points; PDFium's pixels and the blur leave a tenth of that at 600 dpi."""
    sheet_of(board, path)
    image, pixel = raster(path, dpi)
    found = detect(image, board)
    off, turn = rigid_misfit(found.pixels * pixel, board.points()[:, :2])
    assert off < 0.02
    assert abs(np.angle(np.exp(1j * turn))) < 1e-4 or isinstance(board, Chessboard | SymmetricCircles)  # these have two ways up
    if found.radii is not None:
        assert np.abs(2 * found.radii * pixel.mean() - board.diameter_mm).max() < 0.02


@pytest.mark.parametrize("name", BOARDS)
def test_boards_are_found_true_to_scale(name, tmp_path):
    check(BOARDS[name], tmp_path / "board.pdf", 100 if name == "chessboard" else 150)  # chessboards take OpenCV long


@pytest.mark.slow
@pytest.mark.parametrize("name", ["asymmetric", "chessboard", "charuco", "aprilgrid"])  # each detector
def test_boards_are_found_at_a_printers_resolution(name, tmp_path):
    check(BOARDS[name], tmp_path / "board.pdf", 600)


@pytest.mark.parametrize("name", ["asymmetric", "chessboard", "charuco"])
def test_cards_cut_out_are_found_on_a_dark_bench(name, tmp_path):
    """The quiet border is wide enough, and the caption beyond it disturbs nothing."""
    board, path = BOARDS[name], tmp_path / "board.pdf"
    sheet = sheet_of(board, path)
    image, pixel = raster(path, 100 if name == "chessboard" else 150)
    width, height = board_drawing.card_of(board).size
    left, top = sheet.card[0], sheet.paper[1] - sheet.card[1] - height
    (x0, y0), (x1, y1) = (np.rint(np.array(corner) / pixel).astype(int) for corner in ((left, top), (left + width, top + height)))
    bench = np.full_like(image, 20)
    bench[y0:y1, x0:x1] = image[y0:y1, x0:x1]
    found = detect(bench, board)
    assert np.isfinite(found.pixels).all()
    assert rigid_misfit(found.pixels * pixel, board.points()[:, :2])[0] < 0.02


@pytest.mark.parametrize("legacy", [False, True])
def test_charuco_boards_are_opencvs(legacy, tmp_path):
    """The board as OpenCV draws it, but for pixels near the edges."""
    board = Charuco(columns=5, rows=6, square_mm=20, marker_mm=14, legacy=legacy)
    sheet = sheet_of(board, tmp_path / "board.pdf")
    image, pixel = raster(tmp_path / "board.pdf", 127)  # 5 px/mm, so 10 px a cell
    design = cv2.aruco.CharucoBoard((5, 6), 20.0, 14.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100))
    design.setLegacyPattern(legacy)
    theirs = design.generateImage((500, 600))
    quiet = (board_drawing.card_of(board).size[0] - 100) / 2
    height = board_drawing.card_of(board).size[1]
    corner = np.array([sheet.card[0] + quiet, sheet.paper[1] - sheet.card[1] - height + quiet]) / pixel
    to_image = np.column_stack([np.diag(1 / (5 * pixel)), corner - 0.4])
    ours = cv2.warpAffine(image, to_image, (500, 600), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    assert np.mean((ours > 100) != (theirs > 100)) < 0.0015  # 0.0012 at the corners of cells; a false one is 0.0003


def test_a_design_is_said_as_a_field():
    """The field that is printed gives the same board back."""
    from sonotwin.config import load
    from sonotwin.verbs.describe import Config, design

    for board in BOARDS.values():
        fields = ["folder=x", "out=y", f"board={board_drawing.as_field(board)}"]
        assert design(load("describe", fields, Config).board) == board
