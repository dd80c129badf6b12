"""Trust: what is printed is found as it was meant, what is projected is decoded, and a result is there while it is replaced."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.artwork import board_drawing, paper_sheet, projected_images, target_drawing
from recon.artwork.paper_sheet import Card
from recon.board_detection.detect import detect
from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.board_detection.kinds.charuco import Charuco
from recon.board_detection.kinds.chessboard import Chessboard
from recon.board_detection.kinds.symmetric_circles import SymmetricCircles
from recon.model.boards import Board, Discs
from recon.model.circle_layout import circle_centres
from recon.structured_light.decode import decode
from recon.tracking import networks, photographs
from twin.experiments.table_rows import Measurement, Row, Setup

DPI = 600  # of a printer
MARGIN_MM = 5.0
INK, PAPER, BLUR_PX = 12.0, 190.0, 0.7  # DN and px: as a camera has it, with nothing saturated
BOARDS: dict[str, Board] = {
    "asymmetric circles": AsymmetricCircles(columns=4, rows=11, spacing_mm=15, diameter_mm=9),
    "white asymmetric circles": AsymmetricCircles(columns=4, rows=11, spacing_mm=15, diameter_mm=9, white=True),
    "symmetric circles": SymmetricCircles(columns=7, rows=5, spacing_mm=20, diameter_mm=10),
    "chessboard": Chessboard(columns=8, rows=5, square_mm=20),
    "ChArUco": Charuco(columns=8, rows=11, square_mm=20, marker_mm=15),
}
ROUNDING_PX = 0.034  # of the coarsest fringes, 64 px by three steps, in levels of eight bits
REPLACED = 500  # times
WRITER = f"""
from pathlib import Path
from recon.files import atomic
for number in range({REPLACED}):
    with atomic.new_folder(Path("out"), "mark") as folder:
        (folder / "mark").write_text(str(number))
"""


def measurements(setup: Setup) -> list[Measurement]:
    """The rows of the group."""
    return [
        *(lambda name=name, board=board: printed_board(name, board) for name, board in BOARDS.items()),
        lambda: printed_target(setup),
        lambda: projected(setup),
        replaced,
    ]


def printed_board(name: str, board: Board) -> list[Row]:
    """Point f: a board on A4, at a printer's resolution, as our detectors find it."""
    image, pixel = raster(board_drawing.card_of(board))
    found = detect(image, board)
    rows = [Row("f", f"{name}, printed at {DPI} dpi: points off", misfit(found.pixels * pixel, board.points()), 0.02, None, "mm")]
    if found.radii is not None and isinstance(board, Discs):
        worst = float(np.abs(2 * found.radii * pixel.mean() - board.diameter_mm).max())
        rows.append(Row("f", f"{name}, printed at {DPI} dpi: diameters off", worst, 0.02, None, "mm"))
    return rows


def printed_target(setup: Setup) -> list[Row]:
    """Point f: the target on A4, as the tracker finds it."""
    target = setup.rig.target
    image, pixel = raster(target_drawing.card_of(target))
    outlines = photographs.find(image, networks.load(), target).outlines
    off = misfit(outlines.ellipses.centre * pixel * [1, -1], circle_centres(target))
    wide = float(np.abs(2 * outlines.ellipses.semi_axes * pixel.mean() - target.outer_diameter_mm).max())
    what = f"target, printed at {DPI} dpi, found by the tracker's networks"
    return [Row("f", f"{what}: centres off", off, 0.02, None, "mm"), Row("f", f"{what}: diameters off", wide, 0.02, None, "mm")]


def projected(setup: Setup) -> list[Row]:
    """Images for the projector, as a perfect camera on its axis sees them, decoded."""
    rows = []
    for name, patterns in setup.sequences.items():
        found = decode(np.uint16(100) + np.uint16(15) * projected_images.images(patterns), patterns, bits=12)
        height, width = found.status.shape
        pairs = ((found.columns, np.arange(width)), (found.rows, np.arange(height)[:, None]))
        worst = max(float(np.nanmax(np.abs(values - true))) for values, true in pairs if values is not None)
        rows.append(Row("15", f"{name}: images for the projector, decoded: off at most", worst, ROUNDING_PX, None, "px"))
    return rows


def replaced() -> list[Row]:
    """Points 2, b: a folder that is replaced over and over, under the eyes of another process."""
    root = Path(__file__).resolve().parents[2]
    with TemporaryDirectory() as name:
        mark, looks, missing = Path(name, "out", "mark"), 0, 0
        writer = subprocess.Popen([sys.executable, "-c", WRITER], cwd=name, env={"PYTHONPATH": str(root)})
        while writer.poll() is None:
            there = mark.is_file()
            if looks or there:  # it is counted from the first one on
                looks, missing = looks + 1, missing + (not there)
    return [
        Row("2", f"a folder replaced {REPLACED} times: looks of another process that found none", missing, 0, None, ""),
        Row("2", f"a folder replaced {REPLACED} times: looks", looks, 1000, None, "", at_least=True),
    ]


def raster(card: Card) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A card's sheet on A4 as an image (h, w), and the size of a pixel : (2,) mm."""
    import pypdfium2

    with TemporaryDirectory() as name:
        path, sheet = Path(name, "sheet.pdf"), paper_sheet.lay_out(card.size, paper_sheet.PAPERS["a4"], MARGIN_MM)
        assert sheet is not None
        paper_sheet.write(path, card, sheet, MARGIN_MM, "sheet", ["sonotwin"])
        page = pypdfium2.PdfDocument(path)[0]
        image = page.render(scale=DPI / 72, grayscale=True).to_numpy()
        size = np.array(page.get_size())
    levels = cv2.GaussianBlur(INK + (PAPER - INK) / 255 * np.float32(image), (0, 0), BLUR_PX)
    return np.rint(levels).astype(np.uint8), size / image.shape[1::-1] * 25.4 / 72


def misfit(places: NDArray, design: Sequence | NDArray) -> float:
    """Largest distance of places : (n, 2) mm from those of a design : (n, 2 or 3) mm that is turned and shifted to fit best."""
    flat = [np.column_stack([np.asarray(points)[:, :2], np.zeros(len(points))]) for points in (places, design)]
    _, moved, _ = trimesh.registration.procrustes(flat[1], flat[0], reflection=False, scale=False)
    return float(np.linalg.norm(flat[0] - moved, axis=1).max())
