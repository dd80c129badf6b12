"""Chessboards, ChArUco boards and AprilGrids in images."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from recon.board_detection.corners import Corners, refine_corners
from recon.board_detection.findings import MIRRORED, BoardNotFound, Detection, first_faults, refuse_bad, spread
from recon.board_detection.reduced_images import LARGE_PX, reduced
from recon.errors import InputError
from recon.model.boards import AprilGrid, Charuco, Chessboard

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
TAGS_ASTRAY = 1.0  # of a tag, likewise: a wide lens gives 0.3, a wrong number of columns 20 and more
ALTERNATING = 0.3  # of the usual step from one square to the next: least one of a whole board

FEWEST_PX = 1.5e6  # pixels of a large image in which a chessboard is looked for first; see `reduced_images`
TAG_FAMILY = cv2.aruco.DICT_APRILTAG_36h11
RATIOS, WRONG_RATIO = (0.02, 1.0), 0.02  # of gaps to tags, and what isn't an error of corners
SHRUNK = (1, 3, 5)  # px: breadths of what is taken off dark areas, so that tags don't hang together by their corners

_CHESSBOARD = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY  # OpenCV 5 misses clean boards with CALIB_CB_NORMALIZE_IMAGE


def find_chessboard(image: Array, board: Chessboard, full: float) -> Detection:
    """Find all inner corners of a chessboard; see `recon.board_detection.detect.detect`."""
    grey = _eight_bits(image, full)
    looked = reduced(grey, FEWEST_PX)
    found, corners = cv2.findChessboardCornersSB(looked.image, (board.columns, board.rows), flags=_CHESSBOARD)
    if not found and looked.times > 1:
        closer = reduced(grey)
        found, corners = cv2.findChessboardCornersSB(closer.image, (board.columns, board.rows), flags=cv2.CALIB_CB_ACCURACY)
        looked = closer if found else looked
    if not found:
        small = f", looked for in {looked.image.shape[1]}x{looked.image.shape[0]} px" if looked.times > 1 else ""
        raise BoardNotFound(_why_no_chessboard(looked.image, board) + small)
    grid = _begun_rightly(looked.full(np.asarray(corners, float).reshape(board.rows, board.columns, 2)), grey)
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
        raise BoardNotFound(MIRRORED)
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


def find_aprilgrid(image: Array, board: AprilGrid, full: float) -> Detection:
    """Find those corners of an AprilGrid that are in view; see `recon.board_detection.detect.detect`.

    OpenCV has each tag turned by half against AprilTag's own drawing and Kalibr's: its first corner is the lower right one.
    """
    grey = _eight_bits(image, full)
    tags, numbers = _tags(grey, board.border_cells)
    if len(numbers) < min(LEAST_MARKERS, board.columns * board.rows):
        cells = 3 - board.border_cells
        others = {
            MIRRORED: (np.ascontiguousarray(grey[:, ::-1]), board.border_cells),
            f"tags have a border of {cells} cells: give the board border_cells: {cells}": (grey, cells),
        }
        for reason, (other, border) in others.items():
            if len(_tags(other, border)[1]) > 2 * len(numbers):
                raise BoardNotFound(reason)
    if not len(numbers):
        raise BoardNotFound("found no tags of 36h11")
    places = board.corners_of_tags()
    known, several = numbers < len(places), f"{board.columns} x {board.rows}"
    if known.sum() <= len(known) / 2:
        raise BoardNotFound(f"tag {numbers[~known][0]} isn't on a grid of {several} tags: wrong board size")
    at, rough, points = places[numbers[known]].ravel(), tags[known].reshape(-1, 2), board.points()
    if not _astray(points[at], rough, board.tag_mm) < TAGS_ASTRAY:
        turned = board.columns != board.rows and _fits_exchanged(tags[known], numbers[known], board)
        cause = "rows and columns exchanged?" if turned else "wrong columns, rows or spacing_ratio?"
        raise BoardNotFound(f"tags lie otherwise than on a grid of {several} tags: {cause}")
    cell = board.tag_mm / (6 + 2 * board.border_cells)
    clear = (
        MARGIN * min(np.sqrt(2) * board.border_cells * cell, board.rim_mm) / board.tag_mm
    )  # of a tag, to what isn't the corner's
    widest = WINDOW[1] * max(1.0, np.sqrt(image.size / LARGE_PX))  # tags were found in a reduced image, as roughly
    window = min(min(WINDOW[0], clear) * _shortest_side(rough, points[at], board.tag_mm), widest)
    if window < LEAST_WINDOW:
        raise BoardNotFound(f"too small: {window:.1f} px between a corner and the cells of its tag")
    measured = _refine(image, rough, points[at], window, full)
    good = refuse_bad(_faults(measured, window, full), len(at), "corners")
    if good.sum() < LEAST_CORNERS:
        raise BoardNotFound(f"found {good.sum()} corners, fewer than {LEAST_CORNERS}")
    _check_gaps(measured.pixels[good], at[good], board)
    return Detection(
        spread(measured.pixels[good], at[good], len(points)), spread(measured.covariance[good], at[good], len(points)), None
    )


def _check_gaps(pixels: Array, at: NDArray[np.intp], board: AprilGrid) -> None:
    """Refuse a grid whose tags stand at other distances : pixels (n, 2) of the corners `at` (n,)."""

    def misfit(ratio: float) -> float:
        return _astray(board.model_copy(update={"spacing_ratio": ratio}).points()[at], pixels, board.tag_mm)

    found = float(minimize_scalar(misfit, bounds=RATIOS, method="bounded").x)
    if abs(found - board.spacing_ratio) > WRONG_RATIO and misfit(found) < misfit(board.spacing_ratio) / 2:
        raise BoardNotFound(
            f"tags stand as with spacing_ratio {found:.2f}, not {board.spacing_ratio:g}: is that gap over tag_mm?"
        )


def _tags(grey: NDArray[np.uint8], border: int) -> tuple[Array, NDArray[np.int64]]:
    """Corners : (k, 4, 2) px, from the upper left one clockwise, and numbers : (k,) of AprilTags, each of them once."""
    settings = cv2.aruco.DetectorParameters()
    settings.markerBorderBits = border
    detector, looked = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(TAG_FAMILY), settings), reduced(grey)
    found: dict[int, Array] = {}
    for breadth in SHRUNK:
        apart = looked.image if breadth == 1 else cv2.dilate(looked.image, np.ones((breadth, breadth), np.uint8))
        for number, corners in zip(*reversed(_detected(detector, apart)), strict=True):
            found.setdefault(int(number), looked.full(corners[[2, 3, 0, 1]]))
    return np.array(list(found.values())).reshape(-1, 4, 2), np.array(list(found), np.int64)


def _fits_exchanged(tags: Array, numbers: NDArray[np.int64], board: AprilGrid) -> bool:
    """Whether tags : (k, 4, 2) px lie as on a grid that has as many columns as this one has rows."""
    other = board.model_copy(update={"columns": board.rows, "rows": board.columns})
    at = other.corners_of_tags()[numbers].ravel()
    return _astray(other.points()[at], tags.reshape(-1, 2), board.tag_mm) < TAGS_ASTRAY


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
    return _detected(cv2.aruco.ArucoDetector(design.getDictionary()), grey)


def _detected(detector: cv2.aruco.ArucoDetector, grey: NDArray[np.uint8]) -> tuple[Array, NDArray[np.int64]]:
    """Corners : (k, 4, 2) px and numbers : (k,)."""
    corners, numbers, _ = detector.detectMarkers(grey)
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
    if not _astray(points, pixels, board.square_mm) < ASTRAY:
        raise BoardNotFound(f"markers lie otherwise than on the board: {_likely_charuco(markers[known], numbers[known], board)}")


def _astray(points: Array, pixels: Array, side: float) -> float:
    """RMS distance of pixels : (n, 2) from where the best map has the board's points : (n, 3), in sides on the board."""
    back = _moved(np.linalg.inv(_board_to_image(points, pixels)), pixels)
    return float(np.sqrt(np.mean(np.sum((back - points[:, :2]) ** 2, axis=1))) / side)


def _likely_charuco(markers: Array, numbers: NDArray[np.int64], board: Charuco) -> str:
    """The fields of a board on which markers : (k, 4, 2) px lie as they do here, in words."""
    exchanged, other = {"columns": board.rows, "rows": board.columns}, not board.legacy
    which, field = "older" if other else "newer", f"legacy: {str(other).lower()}"
    for update, words in (
        ({"legacy": other}, f"its pattern is OpenCV's {which} one: give the board {field}"),
        (exchanged, "rows and columns exchanged?"),
        (exchanged | {"legacy": other}, f"rows and columns exchanged, and {field}?"),
    ):
        places = charuco_of(board.model_copy(update=update)).getObjPoints()
        points = np.concatenate([np.asarray(places[int(number)], float) for number in numbers])
        if _astray(points, markers.reshape(-1, 2), board.square_mm) < ASTRAY:
            return words
    return "wrong board size?"
