"""Calibration boards in images: each point's place to a hundredth of a pixel, its covariance, or the reason why it's missing.

Discs are dark on a bright board, or white on a dark one if the design says so. Measured is the centre of a disc's ellipse, which
is not yet where the disc's centre is projected to: see `recon.geometry.circle_projection`.

Which way round a board lies follows from its points where it can; an image is never taken for a mirrored one. A grid may look the
same after a turn: a symmetric one, an asymmetric one with an even number of rows, a chessboard whose numbers of squares are both
odd or both even. The first point is then the one nearer to the image's upper left. Of other chessboards the square before the
first corner is the dark one.

That an image is mirrored is told of a ChArUco board, of an AprilGrid, and of an asymmetric grid with an even number of rows. An
odd number makes the grid its own mirror image, as symmetric grids and most chessboards are.
"""

import numpy as np
from numpy.typing import NDArray

from recon.board_detection.findings import BoardNotFound, Detection
from recon.model.boards import Board

__all__ = ["BoardNotFound", "Detection", "detect"]


def detect(image: NDArray, board: Board, *, full: float = 255) -> Detection:
    """Find a calibration board.

    Parameters
    ----------
    image : (h, w) DN
        Grey, of any size and depth.
    board : Board
        Its design.
    full : float
        Largest value that the image can have: 255, 1023, 4095 or 65535.

    Raises
    ------
    BoardNotFound
        With the reason: points that are missing, a mirrored image, another board, too little contrast, blur, glare. Up to a
        quarter of the points may be unusable, as by glare on their rims; they become NaN. Of a ChArUco board, and of an
        AprilGrid, six corners are enough.
    """
    return board.find(np.asarray(image, np.float32), full)
