"""A board's images under patterns other than the given ones: the trial names the fields that differ."""

import numpy as np
import pytest

from recon.board_detection.kinds.chessboard import Chessboard
from recon.capture.board_part import BoardCapture, read_board
from recon.capture.manifest import BoardPart, Device
from recon.capture.writer import new_capture, write_pose
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.patterns import Fringes, GrayCode, Patterns
from recon.pattern_trials import likely_patterns
from tests.recon.board_views import pose, under_patterns

BOARD = Chessboard(columns=5, rows=4, square_mm=28)
CAMERA = Camera((192, 154), np.array([[498.0, 0, 95], [0, 499, 76], [0, 0, 1]]), np.zeros(4))
PROJECTOR = Camera(
    (256, 160),
    np.array([[560.0, 0, 127], [0, 560, 80], [0, 0, 1]]),
    np.array([-0.1, 0.05, 0, 0]),
    rigid.from_rotation_vector(np.deg2rad([0, -15, 0]), [172.0, 4, 45]),
)


def patterns(steps: int = 8, **fields) -> Patterns:
    """Fringes with Gray code along both axes."""
    parts = [
        part
        for axis in ("columns", "rows")
        for part in (Fringes(axis=axis, pitch=16, steps=steps, **fields), GrayCode(axis=axis, pitch=16, bits=4))
    ]
    return Patterns(projector_size=PROJECTOR.size, unwrap="gray", parts=tuple(parts))


def recorded(folder, shown: Patterns, given: Patterns) -> BoardCapture:
    """Two poses under the patterns that were shown, described by those that are given."""
    rng = np.random.default_rng(0)
    with new_capture(folder) as capture:
        records = []
        for name, tilt in (("00", (0.3, -0.25)), ("01", (-0.3, 0.2))):
            images = under_patterns(BOARD, CAMERA, PROJECTOR, shown, pose(BOARD, 640, tilt, 0.1), rng)
            records.append(write_pose(capture.folder, name, {"cam1": images[0]}, {"cam1": images[1:]}))
        devices = {"cam1": Device(size=CAMERA.size), "projector": Device(size=PROJECTOR.size)}
        capture.add_board(BoardPart(board=BOARD, patterns=given, poses=tuple(records)), devices)
    return read_board(folder)


@pytest.mark.parametrize(
    ("shown", "given", "fields"),
    [
        (patterns(backwards=True), patterns(), "backwards: true"),
        (patterns(), patterns(backwards=True), "backwards: false"),
        (patterns(first=4), patterns(), "origin: 135.5 of columns, 87.5 of rows"),
        (patterns(steps=3, first=1), patterns(steps=3), "origin: 135.5 of columns, 87.5 of rows, or first: 1"),
    ],
    ids=["backwards", "onwards", "half a period", "first image last"],
)
def test_the_fields_that_differ_are_named(tmp_path, shown, given, fields):
    """With three steps, half a period and a step both are near enough to give all points their periods."""
    assert likely_patterns.likely(recorded(tmp_path / "capture", shown, given)) == fields


def test_patterns_that_fit_are_left_alone(tmp_path):
    assert likely_patterns.likely(recorded(tmp_path / "capture", patterns(), patterns())) is None
