"""Boards of ArUco or AprilTag markers with the target's face, found and posed by OpenCV's means: what a user would take instead.

Four markers fill the face, as large as their white borders allow, and all edges lie on one grid, so that a picture of cells
describes the face exactly. A marker that can't be read is left out; corners of the others, seen by either camera, give the pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import linearise
from recon.model import circle_layout
from recon.model.rig import Target
from recon.tracking.pose_fit import PARAMETERS, TargetPose, lost

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]
View = tuple[Camera, Array, Array]  # with corners on the board, mm, and in the image, px, of the markers that it sees

CELL_MM = 1.0  # of the grid that all edges lie on
SIDE = 2  # markers along each side of the face
CORNER_PX = 0.1  # no corner counts as more exact: lines drift together by half of it, unseen by residuals; misfits' unit
MOST_PX = 2.0  # RMS of the residuals, beyond which it isn't the board, or these aren't the cameras
LEAST_PERIMETER_PX = 80.0  # of a marker; at 710 mm and 50 deg of tilt one has 370
AROUND_PX = 24  # kept about the markers when their sides are fitted: their white border and a little more
SAME_PX = 10.0  # by which the two ways to find a corner may differ: blur draws single corners far in
SOFT_PX = 0.8  # blur put on top before lines are fitted: without it they move by 0.05 px between sharp and less sharp images
STEPS = 20  # of Gauss and Newton; from a pose that one view gives three or four do
CONVERGED_PX = 1e-6
SCALE = np.array([50.0, 50, 50, 5, 5, 5])  # px a rad and px a mm, roughly: makes the six unknowns alike


@dataclass(frozen=True)
class Board:
    """Markers on the target's face, in the target's frame: x to the right, y up and z towards whoever looks at it."""

    dictionary: int  # OpenCV's number of it
    ids: NDArray[np.int64]  # (m,)
    corners_mm: Array  # (m, 4, 3), clockwise as seen from the front, from each marker's upper left
    cells: Grey  # (rows, columns) 0 black, 1 white; rows along +y: flipped up-down it is what is seen
    cell_mm: float
    origin_mm: Array  # (2,) x, y of the outer corner of cells[0, 0]; the face is white where it has no cells

    @property
    def picture(self) -> Grey:
        """What is seen from the front : (rows, columns) 0 or 255, first row on top, as for a printer."""
        return np.ascontiguousarray(255 * self.cells[::-1])


@dataclass(frozen=True)
class Markers:
    """The markers in one view."""

    camera: Camera
    ids: NDArray[np.int64]  # (n,)
    corners: Array  # (n, 4, 2) px, in the order of Board.corners_mm


def aruco_board(target: Target) -> Board:
    """Four markers of the dictionary 4x4_50, 6 modules wide with their black borders: 24 mm on a face of 60 x 65 mm."""
    return _board(target, cv2.aruco.DICT_4X4_50, 6)


def apriltag_board(target: Target) -> Board:
    """Four tags of the family 36h11, 8 modules wide with their black borders: 24 mm on a face of 60 x 65 mm."""
    return _board(target, cv2.aruco.DICT_APRILTAG_36h11, 8)


def find(image: Grey, board: Board) -> tuple[NDArray[np.int64], Array]:
    """Numbers : (n,) and corners : (n, 4, 2) px of the board's markers in a grey image : (h, w).

    Corners come from lines fitted to the sides, as AprilTag's authors do: refined as corners they are drawn inwards by blur, by
    0.2 px in sharp images and 1 px in blurred ones. As this is slow it is done about the markers only.
    """
    numbers, places = _detected(image, board, cv2.aruco.CORNER_REFINE_SUBPIX)
    known = np.isin(numbers, board.ids)
    known &= np.array([np.sum(numbers == number) == 1 for number in numbers], bool)  # of two of one number neither is trusted
    numbers, places = numbers[known], places[known]
    if len(numbers) == 0:
        return numbers, places
    low = np.maximum(np.floor(places.min(axis=(0, 1))).astype(int) - AROUND_PX, 0)
    high = np.ceil(places.max(axis=(0, 1))).astype(int) + AROUND_PX
    again, lines = _lines(np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]]), board)
    lines = lines + low - _line_offset()
    fitted = np.zeros(len(numbers), bool)
    for number, corners in zip(again, lines, strict=True):
        same = (numbers == number) & (np.abs(places - corners).max(axis=(1, 2)) < SAME_PX)
        places[same] = corners
        fitted |= same
    return (numbers[fitted], places[fitted]) if fitted.any() else (numbers, places)


def sight(image: Grey, camera: Camera, board: Board) -> Markers:
    """The board's markers in the image of a camera."""
    return Markers(camera, *find(image, board))


def estimate(first: Markers, second: Markers, board: Board) -> TargetPose:
    """Estimate the pose by least squares over all corners that either camera sees; one marker in one view is enough.

    The covariance takes its scale from the residuals; the misfit, in units of CORNER_PX, is never below its degrees of freedom.
    """
    views = [(view.camera, _design(view, board), view.corners.reshape(-1, 2)) for view in (first, second) if len(view.ids)]
    if not views:
        return lost("no marker in either view")
    starts = [start for camera, model, pixels in views for start in _starts(camera, model, pixels)]
    fits = [fit for fit in (_refined(start, views) for start in starts) if fit is not None]
    if not fits:
        return lost("markers that do not determine the pose")
    pose, design, residual = min(fits, key=lambda fit: float(fit[2] @ fit[2]))
    rms = float(np.sqrt(np.mean(residual**2)))
    if rms > MOST_PX:
        return lost(f"corners {rms:.1f} px from where the board has them")
    if any(not _faces(pose, camera) for camera, _, _ in views):
        return lost("markers seen from behind")
    freedom = len(residual) - PARAMETERS
    variance = max(float(residual @ residual) / freedom, CORNER_PX**2)
    return TargetPose(pose, variance * np.linalg.inv(design.T @ design), freedom * variance / CORNER_PX**2, freedom=freedom)


def _board(target: Target, dictionary: int, modules: int) -> Board:
    """The largest markers that leave a white module around each of them, spread evenly over the face."""
    columns, rows = (int(np.floor(side / CELL_MM + 1e-9)) for side in target.board_mm)
    scale = min(columns, rows) // (SIDE * modules + SIDE + 1)  # cells a module
    if scale < 1:
        raise ValueError(f"board_mm: expected room for {SIDE}x{SIDE} markers of {modules} modules, found {target.board_mm}")
    size = scale * modules
    left, low = (_spread(count, size) for count in (columns, rows))
    middle = circle_layout.middle(target)[:2]
    origin = middle - np.array([columns, rows]) * CELL_MM / 2
    cells = np.ones((rows, columns), np.uint8)
    corners = []
    family = cv2.aruco.getPredefinedDictionary(dictionary)
    places = [(x, y) for y in reversed(low) for x in left]  # from the upper left, as one reads
    for number, (x, y) in enumerate(places):
        marker = np.asarray(cv2.aruco.generateImageMarker(family, number, modules, borderBits=1)) // 255
        cells[y : y + size, x : x + size] = np.kron(marker[::-1], np.ones((scale, scale), np.uint8))
        corners.append([[x, y + size], [x + size, y + size], [x + size, y], [x, y]])
    flat = origin + CELL_MM * np.array(corners, float)
    return Board(
        dictionary=dictionary,
        ids=np.arange(len(places)),
        corners_mm=np.concatenate([flat, np.zeros((len(places), 4, 1))], axis=-1),
        cells=cells,
        cell_mm=CELL_MM,
        origin_mm=origin,
    )


def _spread(count: int, size: int) -> list[int]:
    """First cells of the markers along a side of `count` cells, gaps and margins alike to a cell."""
    gap = (count - SIDE * size) / (SIDE + 1)
    return [round(gap * (k + 1) + size * k) for k in range(SIDE)]


def _detected(image: Grey, board: Board, refinement: int) -> tuple[NDArray[np.int64], Array]:
    """Numbers : (n,) and corners : (n, 4, 2) px of all markers of the board's dictionary."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin = 5
    parameters.adaptiveThreshWinSizeMax = 65  # markers are 100 px wide and more, modules 15; blur asks for wide windows
    parameters.adaptiveThreshWinSizeStep = 20
    parameters.adaptiveThreshConstant = 5  # images are dim more often than noisy
    parameters.minMarkerPerimeterRate = LEAST_PERIMETER_PX / max(image.shape)
    parameters.cornerRefinementMethod = refinement
    parameters.cornerRefinementMaxIterations = 50
    parameters.cornerRefinementMinAccuracy = 0.005
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(board.dictionary), parameters)
    corners, ids, _ = detector.detectMarkers(image)
    if ids is None or len(corners) == 0:
        return np.empty(0, np.int64), np.empty((0, 4, 2))
    return np.asarray(ids, np.int64).ravel(), np.array([np.asarray(corner, float).reshape(4, 2) for corner in corners])


def _lines(image: Grey, board: Board) -> tuple[NDArray[np.int64], Array]:
    """The same with corners where lines meet, which are fitted to the markers' sides; off by `_line_offset`."""
    return _detected(cv2.GaussianBlur(image, (0, 0), SOFT_PX), board, cv2.aruco.CORNER_REFINE_APRILTAG)


@cache
def _line_offset() -> Array:
    """Offset of this OpenCV's fitted lines : (2,) px, measured on a drawn marker: half a pixel in versions with the fault."""
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    fine = np.full((144 * 4, 144 * 4), 170, np.uint8)
    fine[96:480, 96:480] = 20 + np.asarray(cv2.aruco.generateImageMarker(family, 0, 384)) // 255 * 150
    image = cv2.GaussianBlur(cv2.resize(fine, (144, 144), interpolation=cv2.INTER_AREA), (0, 0), 0.7)
    board = Board(cv2.aruco.DICT_4X4_50, np.array([0]), np.zeros((1, 4, 3)), np.zeros((1, 1), np.uint8), 1.0, np.zeros(2))
    _, corners = _lines(image, board)
    return corners[0].mean(axis=0) - 71.5 if len(corners) else np.zeros(2)


def _design(view: Markers, board: Board) -> Array:
    """Corners : (4 n, 3) mm of the markers seen."""
    place = {int(number): k for k, number in enumerate(board.ids)}
    return board.corners_mm[[place[int(number)] for number in view.ids]].reshape(-1, 3)


def _starts(camera: Camera, model: Array, pixels: Array) -> list[Array]:
    """Both poses world_from_target that a view of a plane allows [Collins & Bartoli 2014]."""
    normalised = camera.undistort(pixels)
    if not np.isfinite(normalised).all():
        return []
    _, turns, shifts, _ = cv2.solvePnPGeneric(
        model.reshape(-1, 1, 3), normalised.reshape(-1, 1, 2), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    world_from_camera = rigid.invert(camera.camera_from_world)
    poses = [rigid.from_rotation_vector(turn.ravel(), shift) for turn, shift in zip(turns, shifts, strict=True)]
    return [world_from_camera @ pose for pose in poses if np.isfinite(pose).all() and pose[2, 3] > 0]


def _linearised(pose: Array, views: Sequence[View]) -> tuple[Array, Array]:
    """Design : (2 n, 6) of all corners by a turn after the pose's own and a shift, and what is left : (2 n,) px."""
    rows, left = [], []
    for camera, model, pixels in views:
        shown = linearise(camera, rigid.apply(pose, model), ())
        rows.append((shown.by_point @ rigid.slopes(rigid.rotate(pose, model))).reshape(-1, 6))
        left.append((pixels - shown.pixels).ravel())
    return np.concatenate(rows), np.concatenate(left)


def _refined(pose: Array, views: Sequence[View]) -> tuple[Array, Array, Array] | None:
    """Pose, design and residuals of least squares over all corners, by Gauss and Newton; None if it goes astray."""
    for _ in range(STEPS):
        design, left = _linearised(pose, views)
        if not np.isfinite(design).all():
            return None
        step, _, rank, _ = np.linalg.lstsq(design / SCALE, left)
        if rank < PARAMETERS:
            return None
        step = step / SCALE
        pose = rigid.moved(pose, step)
        if np.abs(step * SCALE).max() < CONVERGED_PX:
            break
    design, left = _linearised(pose, views)
    return (pose, design, left) if np.isfinite(design).all() else None


def _faces(pose: Array, camera: Camera) -> bool:
    return bool(pose[:3, 2] @ (camera.centre - pose[:3, 3]) > 0)
