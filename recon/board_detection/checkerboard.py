"""Chessboards and ChArUco boards in images."""

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.board_detection.corners import Corners, refine_corners
from recon.board_detection.findings import BoardNotFound, Detection, first_faults, refuse_bad, spread
from recon.errors import InputError
from recon.model.boards import Charuco, Chessboard

Array = NDArray[np.float64]

WINDOW = (0.4, 14.0)  # of a square's shorter side, at most px: radius of what is looked at about a corner
LEAST_WINDOW = 3.0  # px
MARGIN = 0.9  # of the way from a corner to the nearest marker
LEAST_CONTRAST = 0.03  # of the full scale
LEAST_SIGNAL = 4.0  # contrast over noise
LOW_CONTRAST = "contrast of {:.1f} %"
MOST_BLUR = 0.35  # of the window's radius
MOST_CLIPPED = 0.7  # of the window's pixels: white squares fill half of it
MOST_SIGMA = 0.2  # px
LEAST_CORNERS = 6  # of a ChArUco board: enough for a pose
LEAST_MARKERS = 4  # that a mirrored image must show before it is called so
LEAST_SPREAD = 0.5  # of a square: smaller singular value of corners that tell a homography, whichever one is left out
ASTRAY = 0.25  # of a square, RMS of markers about where the board has them
ALTERNATING = 0.3  # of the usual step from one square to the next: least one of a whole board

_CHESSBOARD = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY  # OpenCV 5 misses clean boards with CALIB_CB_NORMALIZE_IMAGE


def find_chessboard(image: Array, board: Chessboard, full: float) -> Detection:
    """Find all inner corners of a chessboard; see `recon.board_detection.detect.detect`."""
    grey = _eight_bits(image, full)
    found, corners = cv2.findChessboardCornersSB(grey, (board.columns, board.rows), flags=_CHESSBOARD)
    if not found:
        raise BoardNotFound(_why_no_chessboard(grey, board))
    grid = _begun_rightly(np.asarray(corners, float).reshape(board.rows, board.columns, 2), grey)
    rough, points = grid.reshape(-1, 2), board.points()
    window = min(WINDOW[0] * _shortest_side(rough, points, board.square_mm), WINDOW[1])
    measured = _refine(image, rough, points, window, full)
    good = refuse_bad(_faults(measured, window, full), len(points), "corners")
    at = np.flatnonzero(good)
    return Detection(spread(measured.pixels[good], at, len(points)), spread(measured.covariance[good], at, len(points)), None)


def find_charuco(image: Array, board: Charuco, full: float) -> Detection:
    """Find those inner corners of a ChArUco board that are in view; see `recon.board_detection.detect.detect`."""
    grey = _eight_bits(image, full)
    design = charuco_of(board)
    markers, numbers = _markers(grey, design)
    if len(numbers) < LEAST_MARKERS and len(_markers(np.ascontiguousarray(grey[:, ::-1]), design)[1]) >= LEAST_MARKERS:
        raise BoardNotFound("image is mirrored")
    if not len(numbers):
        raise BoardNotFound(f"found no markers of {board.dictionary}")
    _check_markers(markers, numbers, design, board)
    corners, ids = cv2.aruco.CharucoDetector(design).detectBoard(grey)[:2]
    count = 0 if ids is None else len(ids)
    if count < LEAST_CORNERS:
        raise BoardNotFound(f"found {count} corners beside {len(numbers)} markers, fewer than {LEAST_CORNERS}")
    rough, at = np.asarray(corners, float).reshape(-1, 2), np.asarray(ids).ravel()
    points = board.points()
    if _on_one_line(points[at], board.square_mm):
        raise BoardNotFound("corners all on one line, but for one at most")
    side = _shortest_side(rough, points[at], board.square_mm)
    clear = MARGIN * (board.square_mm - board.marker_mm) / np.sqrt(2) / board.square_mm  # of a square, to the nearest marker
    window = min(min(WINDOW[0], clear) * side, WINDOW[1])
    if window < LEAST_WINDOW:
        raise BoardNotFound(f"too small: {window:.1f} px between corners and markers")
    measured = _refine(image, rough, points[at], window, full)
    good = refuse_bad(_faults(measured, window, full), count, "corners")
    return Detection(
        spread(measured.pixels[good], at[good], len(points)), spread(measured.covariance[good], at[good], len(points)), None
    )


def _eight_bits(image: Array, full: float) -> NDArray[np.uint8]:
    """For OpenCV's detectors, the brightest thousandth clipped."""
    top = max(float(np.percentile(image[::4, ::4], 99.9)), 0.04 * full)
    return np.clip(image * (255 / top), 0, 255).astype(np.uint8)


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
    homography = _board_to_image(np.stack([column, row], axis=-1).reshape(-1, 2), grid.reshape(-1, 2))
    row, column = np.mgrid[: rows + 1, : columns + 1]  # of the squares
    at = np.rint(_moved(homography, np.stack([column, row], axis=-1).reshape(-1, 2) - 0.5)).astype(int)
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


def _on_one_line(points: Array, square_mm: float) -> bool:
    """Whether all corners but one lie on a line, or all of them: no homography follows from these."""
    planar = points[:, :2] / square_mm
    rests = (np.delete(planar, k, axis=0) for k in range(len(planar)))
    return min(np.linalg.svd(rest - rest.mean(axis=0), compute_uv=False)[1] for rest in rests) < LEAST_SPREAD


def _board_to_image(points: Array, pixels: Array) -> Array:
    """Homography : (3, 3), by least squares."""
    return np.asarray(cv2.findHomography(points[:, :2].astype(float), pixels.astype(float), 0)[0])


def _moved(homography: Array, points: Array) -> Array:
    moved = np.column_stack([points[:, :2], np.ones(len(points))]) @ homography.T
    return moved[:, :2] / moved[:, 2:]


def _shortest_side(pixels: Array, points: Array, square_mm: float) -> float:
    """Of the squares about the corners, px."""
    homography = _board_to_image(points, pixels)
    sides = [np.hypot(*(_moved(homography, points + step) - _moved(homography, points)).T) for step in square_mm * np.eye(3)[:2]]
    return float(np.min(sides))


def _refine(image: Array, rough: Array, points: Array, window: float, full: float) -> Corners:
    """Corners at their best, the edges' directions taken from the board."""
    homography = _board_to_image(points, rough)
    step = 1e-3 * np.ptp(points, axis=0).max() * np.eye(3)
    directions = np.stack([_moved(homography, points + step[k]) - _moved(homography, points) for k in range(2)], axis=1)
    return refine_corners(image, rough, directions, window, full)


def _faults(corners: Corners, window: float, full: float) -> list[str | None]:
    """Reasons to refuse each corner, None for good ones."""
    contrast = np.abs(corners.contrast)
    sigma = np.sqrt(np.trace(corners.covariance, axis1=1, axis2=2) / 2)
    tests = [
        (
            contrast < np.maximum(LEAST_CONTRAST * full, LEAST_SIGNAL * corners.noise),
            100 * contrast / full,
            LOW_CONTRAST,
        ),
        (corners.clipped > MOST_CLIPPED, 100 * corners.clipped, "saturated, {:.0f} % of it"),
        (corners.blur > MOST_BLUR * window, corners.blur, "too blurred, {:.1f} px"),
        (corners.shift > window / 2, corners.shift, "no corner within {:.1f} px"),
        (~(sigma < MOST_SIGMA), sigma, "uncertain by {:.2f} px"),
    ]
    return first_faults(tests, len(contrast))


def charuco_of(board: Charuco) -> cv2.aruco.CharucoBoard:
    """OpenCV's board of a design; raises InputError if its dictionary is unknown, or has too few markers."""
    number = getattr(cv2.aruco, board.dictionary, None)
    if not isinstance(number, int):
        raise InputError(f"dictionary: expected one of OpenCV's, such as DICT_5X5_100, found {board.dictionary!r}")
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    needed, there = board.columns * board.rows // 2, len(dictionary.bytesList)
    if needed > there:
        raise InputError(
            f"dictionary: expected at least {needed} markers for so many squares, found {there} in {board.dictionary}"
        )
    design = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_mm, board.marker_mm, dictionary)
    design.setLegacyPattern(board.legacy)
    return design


def _markers(grey: NDArray[np.uint8], design: cv2.aruco.CharucoBoard) -> tuple[Array, NDArray[np.int64]]:
    """Corners : (k, 4, 2) px and numbers : (k,) of the markers in view."""
    corners, numbers, _ = cv2.aruco.ArucoDetector(design.getDictionary()).detectMarkers(grey)
    if numbers is None or not len(numbers):
        return np.empty((0, 4, 2)), np.empty(0, np.int64)
    return np.asarray(corners, float).reshape(-1, 4, 2), np.asarray(numbers, np.int64).ravel()


def _check_markers(markers: Array, numbers: NDArray[np.int64], design: cv2.aruco.CharucoBoard, board: Charuco) -> None:
    """Refuse a board with other markers, or with these in other places."""
    ids = np.asarray(design.getIds()).ravel().tolist()
    places = dict(zip(ids, np.asarray(design.getObjPoints(), float), strict=True))
    known = np.array([int(number) in places for number in numbers])
    if known.sum() <= len(known) / 2:
        raise BoardNotFound(
            f"marker {numbers[~known][0]} isn't on a board of {board.columns} x {board.rows} squares: wrong board size"
        )
    points = np.concatenate([places[int(number)] for number in numbers[known]])
    pixels = markers[known].reshape(-1, 2)
    back = _moved(np.linalg.inv(_board_to_image(points, pixels)), pixels)
    astray = np.sqrt(np.mean(np.sum((back - points[:, :2]) ** 2, axis=1))) / board.square_mm
    if not astray < ASTRAY:
        raise BoardNotFound("markers lie otherwise than on the board: wrong board size, or its pattern is OpenCV's other one")
