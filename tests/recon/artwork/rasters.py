"""Sheets as a printer of 600 dpi would put them on paper, for tests."""

import cv2
import numpy as np
import pypdfium2

INK, PAPER = 12.0, 190.0  # DN, so that nothing is saturated, as in a camera
BLUR = 0.7  # px, of a lens


def raster(path, dpi=600):
    """The page of a PDF : (h, w) uint8, and the size of a pixel : (2,) mm, as PDFium stretches a page onto whole pixels."""
    page = pypdfium2.PdfDocument(path)[0]
    image = page.render(scale=dpi / 72, grayscale=True).to_numpy()
    image = np.rint(cv2.GaussianBlur(INK + (PAPER - INK) / 255 * np.float32(image), (0, 0), BLUR)).astype(np.uint8)
    return image, np.array(page.get_size()) / image.shape[1::-1] * 25.4 / 72


def rigid_misfit(places, design):
    """Largest distance of places : (n, 2) mm from those of a design, turned and shifted to fit best, and the turn, rad."""
    a, b = (x - x.mean(axis=0) for x in (places, design))
    turn = np.angle(np.sum((a[:, 0] + 1j * a[:, 1]) * np.conj(b[:, 0] + 1j * b[:, 1])))
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return np.hypot(*(a - b @ rotation.T).T).max(), turn
