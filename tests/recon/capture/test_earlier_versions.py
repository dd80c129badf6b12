"""Captures that version 0.1.0 wrote, kept as files in `version_0_1_0/`, are read as they were meant."""

from pathlib import Path

import numpy as np
import pytest

from recon.capture.board_part import read_board
from recon.capture.stereo_frames import read_film
from recon.capture.surface_part import read_surface
from recon.capture.sweep_part import read_sweep
from recon.geometry import rigid
from recon.model.boards import Discs
from recon.model.patterns import Fringes

KEPT = Path(__file__).with_name("version_0_1_0")
START_NS = 1_700_000_000_123_456_789


def images(count: int, first: int = 0, bits: int = 8) -> np.ndarray:
    """What was written, by a formula : (n, 12, 16)."""
    v, u = np.mgrid[:12, :16]
    grown = 1 if bits == 8 else 11
    return np.stack([grown * (7 * (k + first) + u + 3 * v) % 2**bits for k in range(count)])


def test_a_surface_with_its_calibration():
    found = read_surface(KEPT / "surface")
    np.testing.assert_array_equal(found.images, images(9))
    assert (found.name, found.bits, found.patterns.count) == ("plate", 8, 9)
    assert found.patterns.parts[1] == Fringes(axis="columns", pitch=12, steps=8)
    second, projector = (found.calibration.cameras[name] for name in ("cam2", "projector"))
    np.testing.assert_allclose(second.camera_from_world, rigid.from_rotation_vector([0, 0.25, 0], [-160, 1, 20]), atol=1e-12)
    assert projector.size == (1280, 800) and second.distortion[:5].tolist() == [-0.1, 0.2, 1e-3, -2e-3, 0]
    assert found.calibration.uncertainty.sigma("projector.fx") == 3
    deeper = read_surface(KEPT / "surface", "cam2")
    np.testing.assert_array_equal(deeper.images, images(9, bits=10))
    assert deeper.bits == 10


def test_a_board():
    found = read_board(KEPT / "board")
    assert (found.name, found.poses, found.cameras) == ("monday", ("00", "01"), ("cam1", "cam2"))
    assert isinstance(found.board, Discs) and found.board.diameter_mm == 7
    row, column = np.divmod(np.arange(20), 4)  # rows stand half a step off each other
    np.testing.assert_allclose(found.board.points(), 9 * np.column_stack([2 * column + row % 2, row, 0 * row]))
    device = found.devices["cam1"]
    assert (device.exposure_s, device.gain, found.devices["cam2"].bits) == (0.01, 1.5, 10)
    for number in range(2):
        pose = found.pose(number)
        np.testing.assert_array_equal(pose.fringes, images(8, number))
        np.testing.assert_array_equal(pose.lit["cam1"], images(1, number)[0])
        np.testing.assert_array_equal(pose.lit["cam2"], images(1, 5, bits=10)[0])


def test_a_sweep_with_its_track_and_its_probe():
    found = read_sweep(KEPT / "sweep")
    assert found.name == "breast" and found.times.tolist() == [START_NS + 33_000_000 * k for k in range(3)]
    np.testing.assert_array_equal(np.stack(list(found.images())), images(3))
    assert found.track.found.tolist() == [True, True, True, False, True]
    np.testing.assert_allclose(found.track.poses[2], rigid.from_rotation_vector([0.03, 0, 0.04], [1, -3, 700]), atol=1e-9)
    np.testing.assert_allclose(found.track.covariance[0], np.diag([1e-6] * 3 + [1e-2] * 3))
    assert found.probe.scale.tolist() == [0.12, 0.11] and found.probe.uncertainty.sigma("sx") == pytest.approx(1e-4)
    np.testing.assert_allclose(found.probe.target_from_image, rigid.from_rotation_vector([1.5, 0.1, 0], [-7, 80, 90]), atol=1e-12)


def test_a_film():
    found = read_film(KEPT / "film")
    assert found.name == "hand" and found.times.tolist() == [START_NS + 33_000_000 * k for k in range(3)]
    for k, pair in enumerate(found.pairs()):
        for image, first in zip(pair, (0, 9), strict=True):
            np.testing.assert_array_equal(image, images(3, first)[k])
