"""Synthetic photographs of calibration boards for tests: rays of sub-pixels meet the board's plane, then blur and noise."""

import cv2
import numpy as np

from recon.board_detection.kinds.aprilgrid import AprilGrid
from recon.board_detection.kinds.charuco import Charuco
from recon.board_detection.kinds.symmetric_circles import SymmetricCircles
from recon.geometry import rigid
from recon.model.boards import Discs
from tests.recon import plane_views

SUB = 4  # sub-pixels a pixel and axis


def pose(board, distance, tilt=(0.0, 0.0), turn=0.0, centre=(0.0, 0.0)):
    """world_from_board : (4, 4), the board's middle at a distance on the camera's axis, turned in its plane, then tilted."""
    points = board.points()
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    rotation = cv2.Rodrigues(np.array([tilt[0], tilt[1], 0.0]))[0] @ cv2.Rodrigues(np.array([0, 0, turn]))[0]
    result = np.eye(4)
    result[:3, :3] = rotation
    result[:3, 3] = [centre[0], centre[1], distance] - rotation @ middle
    return result


def shares(board, xy, footprint):
    """How white the board is about (..., 2) mm: 1 on the ground, 0 on a disc or a black square, between them across a rim."""
    if isinstance(board, Discs):
        return np.clip((_to_nearest(board, xy) - board.diameter_mm / 2) / footprint + 0.5, 0, 1)
    if isinstance(board, Charuco):
        return _of_charuco(board, xy)
    if isinstance(board, AprilGrid):
        return _of_aprilgrid(board, xy)
    squares = xy / board.square_mm
    line = np.rint(squares)
    signs = np.where(line % 2 == 0, 1, -1) * np.clip(2 * (squares - line) * board.square_mm / footprint, -1, 1)
    inside = ((squares > -1) & (squares < [board.columns, board.rows])).all(axis=-1)
    return np.where(inside, (1 - signs.prod(axis=-1)) / 2, 1.0)


def _of_charuco(board, xy):
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    design = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_mm, board.marker_mm, dictionary)
    design.setLegacyPattern(board.legacy)
    scale = 16  # px/mm
    picture = design.generateImage((int(board.columns * board.square_mm * scale), int(board.rows * board.square_mm * scale)))
    at = np.floor((xy + board.square_mm) * scale).astype(int)
    inside = ((at >= 0) & (at < picture.shape[::-1])).all(axis=-1)
    at = np.clip(at, 0, np.array(picture.shape[::-1]) - 1)
    return np.where(inside, picture[at[..., 1], at[..., 0]] / 255, 1.0)


def _of_aprilgrid(board, xy):
    """As Kalibr prints it: tag 0 at the lower left, tags turned by half against OpenCV's, black squares in the corners."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    cells = 6 + 2 * board.border_cells
    tags = [
        np.rot90(cv2.aruco.generateImageMarker(dictionary, number, cells, borderBits=board.border_cells), 2) / 255
        for number in range(board.columns * board.rows)
    ]
    tags = np.array(tags).reshape(board.rows, board.columns, cells, cells)[::-1]
    side, pitch = board.tag_mm, board.tag_mm * (1 + board.spacing_ratio)
    at = np.floor(xy / pitch).astype(int)
    within = xy - at * pitch  # of a tag and the gap after it
    column, row = at[..., 0], at[..., 1]
    there = (column >= 0) & (column < board.columns) & (row >= 0) & (row < board.rows) & (within < side).all(axis=-1)
    cell = np.clip((within * cells / side).astype(int), 0, cells - 1)
    white = tags[np.clip(row, 0, board.rows - 1), np.clip(column, 0, board.columns - 1), cell[..., 1], cell[..., 0]]
    squares = (within >= side).all(axis=-1) & (at >= -1).all(axis=-1) & (column < board.columns) & (row < board.rows)
    return np.where(there, white, np.where(squares, 0.0, 1.0))


def _to_nearest(board, xy):
    """Distance from the nearest disc's centre : (...) mm."""
    step = board.spacing_mm
    row = np.clip(np.rint(xy[..., 1] / step), 0, board.rows - 1)
    if isinstance(board, SymmetricCircles):
        column = np.clip(np.rint(xy[..., 0] / step), 0, board.columns - 1)
        return np.hypot(xy[..., 0] - column * step, xy[..., 1] - row * step)
    across, along = np.rint((xy[..., 0] + xy[..., 1]) / (2 * step)), np.rint((xy[..., 0] - xy[..., 1]) / (2 * step))
    column, row = across + along, across - along  # of the nearest place of the lattice: if it is none of the board, none is near
    there = (row >= 0) & (row < board.rows) & (column >= 0) & (column < 2 * board.columns)
    return np.where(there, np.hypot(xy[..., 0] - column * step, xy[..., 1] - row * step), np.inf)


def _near_edges(board, at, pixel):
    """Shares : (SUB h, SUB w) of sub-pixels, each by its place where an edge is near; else as its pixel's.

    at : (h + 2, w + 2, 2) mm, seen by the pixels' centres and those around; pixel : mm, its footprint.
    """
    rough = shares(board, at[1:-1, 1:-1], 3 * pixel)
    result = np.repeat(np.repeat(rough, SUB, axis=0), SUB, axis=1)
    near = ((rough > 0) & (rough < 1)).astype(np.uint8)
    v, u = np.nonzero(cv2.dilate(near, np.ones((3, 3), np.uint8)))  # beyond a board's border all is white at once
    for j, dv in enumerate((np.arange(SUB) + 0.5) / SUB - 0.5):
        for i, du in enumerate((np.arange(SUB) + 0.5) / SUB - 0.5):
            beside, below = u + 1 + int(np.sign(du)), v + 1 + int(np.sign(dv))
            here, there = ((1 - abs(du)) * at[row, u + 1] + abs(du) * at[row, beside] for row in (v + 1, below))
            result[SUB * v + j, SUB * u + i] = shares(board, (1 - abs(dv)) * here + abs(dv) * there, pixel / SUB)
    return result


def view(board, camera, world_from_board, *, blur=0.7, dark=40.0, white=180.0, noise=0.0, rng=None, paint=None):
    """Grey image : (h, w) float DN; `paint` may change the sub-sampled brightness, given the board's coordinates."""
    width, height = camera.size
    at = plane_views.places(camera, world_from_board, np.arange(-1.0, height + 1), np.arange(-1.0, width + 1))
    along_v, along_u = (at[-2, 1] - at[1, 1]) / (height - 1), (at[1, -2] - at[1, 1]) / (width - 1)
    pixel = np.sqrt(abs(along_u[0] * along_v[1] - along_u[1] * along_v[0]))
    if paint is not None or isinstance(board, AprilGrid | Charuco):
        xy = cv2.resize(at, None, fx=SUB, fy=SUB, interpolation=cv2.INTER_LINEAR)[SUB:-SUB, SUB:-SUB]
        white_share = shares(board, xy, pixel / SUB)
    else:
        white_share = _near_edges(board, at, pixel)
    bright = dark + (white - dark) * white_share
    if paint is not None:
        bright = paint(bright, xy)
    if blur:
        bright = cv2.GaussianBlur(bright.astype(np.float32), (0, 0), blur * SUB, borderType=cv2.BORDER_REPLICATE)
    image = cv2.resize(np.float64(bright), (width, height), interpolation=cv2.INTER_AREA)  # the mean
    if noise:
        image = np.rint(image + rng.normal(0, noise, image.shape))
    return np.clip(image, 0, 255)


def under_patterns(board, camera, projector, patterns, world_from_board, rng, bits=8):
    """Camera's images : (1 + n, h, w) of the board, lit and then under each pattern, with 0.7 DN of noise, of 255."""
    lit, full = view(board, camera, world_from_board, dark=80), 2**bits - 1
    board_from_world = rigid.invert(world_from_board)
    rays, normal = camera.rays(camera.pixel_grid()), board_from_world[2]
    surface = rays * (-normal[3] / (rays @ normal[:3]))[..., None]
    at = projector.project(surface).astype(np.float32)
    light = np.stack([cv2.remap(np.float32(image), at[..., 0], at[..., 1], cv2.INTER_LINEAR) for image in patterns.images()])
    images = np.concatenate([lit[None], lit * light])
    noisy = np.rint((images + rng.normal(0, 0.7, images.shape)) * full / 255)
    return np.clip(noisy, 0, full).astype(np.uint8 if bits == 8 else np.uint16)
