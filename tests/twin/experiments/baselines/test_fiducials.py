"""Fiducial boards: what is printed is what is found, and the pose that follows."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from tests.recon.tracking import flat_faces
from twin.experiments.baselines import fiducials
from twin.optics.surface_session import calibration_of

MAKERS = [fiducials.aruco_board, fiducials.apriltag_board]


@pytest.fixture(scope="module")
def cameras(rig):
    known = calibration_of(rig).cameras
    return known["cam1"], known["cam2"]


def seen(cameras, board, target, true, rng, **look):
    face = flat_faces.cells(board, target)
    images = [flat_faces.view(camera, true, face, target, rng=rng, **look) for camera in cameras]
    return [fiducials.sight(image, camera, board) for image, camera in zip(images, cameras, strict=True)]


def error(found, true):
    """Turn, deg, and shift, mm."""
    turn = Rotation.from_matrix(found[:3, :3] @ true[:3, :3].T).magnitude()
    return np.rad2deg(turn), np.linalg.norm(found[:3, 3] - true[:3, 3])


@pytest.mark.parametrize("make", MAKERS)
def test_the_grid_covers_the_face_and_holds_the_corners(rig, make):
    board = make(rig.target)
    rows, columns = board.cells.shape
    assert (columns * board.cell_mm, rows * board.cell_mm) == rig.target.board_mm
    assert np.allclose(board.origin_mm, flat_faces.corner_of(rig.target))
    assert board.cells[[0, -1]].all() and board.cells[:, [0, -1]].all()
    at = np.rint((board.corners_mm[..., :2] - board.origin_mm) / board.cell_mm).astype(int)
    assert np.allclose(at * board.cell_mm + board.origin_mm, board.corners_mm[..., :2])
    for corners in at:
        (left, low), (right, high) = corners.min(axis=0), corners.max(axis=0)
        assert not board.cells[low:high, [left, right - 1]].any() and not board.cells[[low, high - 1], left:right].any()
        assert board.cells[low - 1 : high + 1, [left - 1, right]].all() and board.cells[[low - 1, high], left:right].all()


@pytest.mark.parametrize("make", MAKERS)
def test_the_printed_picture_reads_the_right_way_round(rig, make):
    """OpenCV finds all markers in the picture, with the corners where the board has them."""
    board = make(rig.target)
    scale = 8
    picture = cv2.copyMakeBorder(board.picture, 4, 4, 4, 4, cv2.BORDER_CONSTANT, value=255)
    numbers, corners = fiducials.find(np.kron(picture, np.ones((scale, scale), np.uint8)), board)
    assert sorted(numbers) == list(board.ids)
    height = board.cells.shape[0] * board.cell_mm
    x, y = np.moveaxis(board.corners_mm[numbers, :, :2] - board.origin_mm, -1, 0)
    expected = (np.stack([x, height - y], axis=-1) / board.cell_mm + 4) * scale - 0.5
    assert np.abs(corners - expected).max() < 0.5


@pytest.mark.parametrize("make", MAKERS)
def test_the_pose_is_exact_to_hundredths(cameras, rig, rng, make):
    board = make(rig.target)
    errors = []
    for _ in range(3):
        true = flat_faces.facing(rng.uniform(-28, 28, 2), rng.uniform(-180, 180), rng.uniform([-40, -40, 610], [40, 40, 700]))
        views = seen(cameras, board, rig.target, true, rng)
        found = fiducials.estimate(*views, board)
        assert found.found, found.reason
        assert all(len(view.ids) == 4 for view in views)
        errors.append(error(found.world_from_target, true))
    turn, shift = np.sqrt(np.mean(np.square(errors), axis=0))
    assert turn < 0.04 and shift < 0.04  # 0.01 deg and 0.015 mm are usual


@pytest.mark.parametrize("make", MAKERS)
def test_missing_markers_cost_accuracy_only(cameras, rig, rng, make):
    board = make(rig.target)
    true = flat_faces.facing((15, -20), 35)
    views = seen(cameras, board, rig.target, true, rng)
    less = [
        replace(view, ids=view.ids[keep], corners=view.corners[keep]) for view, keep in zip(views, ([0], [2, 3]), strict=True)
    ]
    none = replace(views[1], ids=views[1].ids[:0], corners=views[1].corners[:0])
    whole, part, one = (fiducials.estimate(*pair, board) for pair in (views, less, (views[0], none)))
    for found, worst in ((whole, 0.05), (part, 0.15), (one, 0.6)):
        turn, shift = error(found.world_from_target, true)
        assert turn < worst and shift < 2 * worst
    traces = [np.trace(found.covariance[3:, 3:]) for found in (whole, part, one)]
    assert traces[0] < traces[1] < traces[2]
    lost = fiducials.estimate(none, none, board)
    assert not lost.found and "no marker" in lost.reason


def test_a_covered_marker_is_left_out(cameras, rig, rng):
    board = fiducials.aruco_board(rig.target)
    true = flat_faces.facing((10, 10), 0)
    image = flat_faces.view(cameras[0], true, flat_faces.cells(board, rig.target), rig.target, rng=rng)
    u, v = cameras[0].project(rigid.apply(true, board.corners_mm[3])).mean(axis=0).astype(int)
    cv2.circle(image, (u + 40, v + 40), 50, 120, -1)
    assert sorted(fiducials.find(image, board)[0]) == [0, 1, 2]


def test_predicted_errors_are_not_less_than_the_errors(cameras, rig, rng):
    """Squared normalised errors of 6 poses: a mean of 6 and less, as the floor counts errors in common; not above 12."""
    board = fiducials.aruco_board(rig.target)
    squared = []
    for _ in range(6):
        true = flat_faces.facing(rng.uniform(-25, 25, 2), rng.uniform(-180, 180))
        found = fiducials.estimate(*seen(cameras, board, rig.target, true, rng, blur=1.2, noise=2.0), board)
        turn = Rotation.from_matrix(found.world_from_target[:3, :3] @ true[:3, :3].T).as_rotvec()
        off = np.concatenate([turn, found.world_from_target[:3, 3] - true[:3, 3]])
        squared.append(off @ np.linalg.solve(found.covariance, off))
    assert 0.3 < np.mean(squared) < 12


def test_other_cameras_or_names_are_not_the_board(cameras, rig, rng):
    board = fiducials.aruco_board(rig.target)
    first, second = seen(cameras, board, rig.target, flat_faces.facing((15, -20), 35), rng)
    swapped = fiducials.estimate(replace(first, camera=cameras[1]), replace(second, camera=cameras[0]), board)
    renamed = fiducials.estimate(replace(first, ids=first.ids[::-1]), second, board)
    for found in (swapped, renamed):
        assert not found.found and found.reason


@pytest.mark.parametrize("make", MAKERS)
def test_nothing_where_there_is_no_board(cameras, rig, rng, make):
    shape = cameras[0].size[::-1]
    for image in (rng.integers(0, 256, shape).astype(np.uint8), np.full(shape, 80, np.uint8), flat_faces.clutter(shape, rng)):
        assert len(fiducials.find(image, make(rig.target))[0]) == 0
