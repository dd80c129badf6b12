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
from twin.experiments.experiment_setup import Figures, Setup

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
REPLACED = 500  # times
WRITER = f"""
from pathlib import Path
from recon.files import atomic
for number in range({REPLACED}):
    with atomic.new_folder(Path("out"), "mark") as folder:
        (folder / "mark").write_text(str(number))
"""


def printed_board(setup: Setup, board: str) -> Figures:
    """A board on A4, at a printer's resolution, as our detectors find it."""
    design = BOARDS[board]
    image, pixel = raster(board_drawing.card_of(design))
    found = detect(image, design)
    figures = {"dpi": DPI, "points_mm": misfit(found.pixels * pixel, design.points())}
    if found.radii is not None and isinstance(design, Discs):
        figures["diameters_mm"] = np.abs(2 * found.radii * pixel.mean() - design.diameter_mm).max()
    return figures


def printed_target(setup: Setup) -> Figures:
    """The target on A4, as the tracker finds it."""
    target = setup.rig.target
    image, pixel = raster(target_drawing.card_of(target))
    outlines = photographs.find(image, networks.load(kind=target.kind), target).outlines
    off = misfit(outlines.ellipses.centre * pixel * [1, -1], circle_centres(target))
    wide = np.abs(2 * outlines.ellipses.semi_axes * pixel.mean() - target.outer_diameter_mm).max()
    return {"dpi": DPI, "centres_mm": off, "diameters_mm": wide}


def projected(setup: Setup) -> Figures:
    """Images for the projector, as a perfect camera on its axis sees them, decoded: off at most, px, by the sequence."""
    worst: Figures = {}
    for name, patterns in setup.sequences.items():
        found = decode(np.uint16(100) + np.uint16(15) * projected_images.images(patterns), patterns, bits=12)
        height, width = found.status.shape
        pairs = ((found.columns, np.arange(width)), (found.rows, np.arange(height)[:, None]))
        worst[name] = max(np.nanmax(np.abs(values - true)) for values, true in pairs if values is not None)
    return worst


def replaced(setup: Setup) -> Figures:
    """A folder that is replaced over and over, under the eyes of another process."""
    root = Path(__file__).resolve().parents[2]
    with TemporaryDirectory() as name:
        mark, looks, missing = Path(name, "out", "mark"), 0, 0
        writer = subprocess.Popen([sys.executable, "-c", WRITER], cwd=name, env={"PYTHONPATH": str(root)})
        while writer.poll() is None:
            there = mark.is_file()
            if looks or there:  # it is counted from the first one on
                looks, missing = looks + 1, missing + (not there)
    return {"times": REPLACED, "looks": looks, "missing": missing}


def raster(card: Card) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A card's sheet on A4 as an image (h, w), and the size of a pixel : (2,) mm."""
    import pypdfium2

    with TemporaryDirectory() as name:
        path, sheet = Path(name, "sheet.pdf"), paper_sheet.lay_out(card.size, paper_sheet.PAPERS["a4"], MARGIN_MM)
        assert sheet is not None
        paper_sheet.write(path, [paper_sheet.Page(card, sheet, ["sonotwin"])], MARGIN_MM, "sheet")
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
