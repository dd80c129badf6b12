"""What the paper's figures are made of: the figures themselves, against closed forms."""

import numpy as np
import pytest

from recon.optical_calibration.joint_calibration import Settings, calibrate
from twin.conditions import BoardPrint
from twin.experiments import lifelike_accuracy, plane_and_sphere
from twin.experiments.baselines import opencv_peer


def test_the_form_of_a_bowed_plane_is_its_bow(rng):
    """A parabola of a (x^2 - 1/3) along a side from -1 to 1 has an RMS of a sqrt(4/45); noise and tilt don't count."""
    x, y = rng.uniform(-1, 1, (2, 200_000))
    z = 0.01 * x**2 + 0.3 * x - 0.2 * y + 0.02 * rng.standard_normal(x.size)
    points = np.column_stack([120 * x, 90 * y, z + 660])
    assert plane_and_sphere.form_rms(points) == pytest.approx(0.01 * np.sqrt(4 / 45), rel=0.05)


def test_a_print_shows_in_the_reprojection_as_large_as_it_is(rig):
    """Dots 0.02 mm off in x and y are 0.14 px off at 660 mm; 88 draws scatter by 8 %, and poses and lens take as much."""
    seen = lifelike_accuracy.sighted(rig, BoardPrint(place_mm=0.02), 5)
    brown = Settings(distortion="brown")  # which of the models is of no account here
    observations = calibrate(seen.sightings, seen.board, seen.sizes, brown).observations
    expected = 0.02 * np.sqrt(2) * rig.cam1.optics.focal_px[0] / 660
    assert 0.75 * expected < opencv_peer.reprojection_rms(observations, "cam1") < 1.25 * expected
    exact = lifelike_accuracy.sighted(rig, BoardPrint(), 5)
    observations = calibrate(exact.sightings, exact.board, exact.sizes, brown).observations
    assert opencv_peer.reprojection_rms(observations, "cam1") < 0.01
