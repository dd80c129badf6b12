"""A calibration of impossible scales is refused, and an unusual one is doubted."""

import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry import rigid
from recon.model.probe import SPEEDS, ProbeCalibration
from recon.probe_calibration import probe_checks
from recon.probe_calibration.probe_checks import WATER
from tests.recon.bscans import SIZE
from tests.recon.probe_motions import true_probe


@pytest.fixture
def probe(rig):
    return true_probe(rig)


def test_a_tiny_image_makes_a_doubt_of_the_poses_unit(probe):
    """Of a rig without a design poses in cm can't be excluded: images for the skin are as small."""
    small = rigid.transform(probe.target_from_image[:3, :3], probe.target_from_image[:3, 3] / 10)
    said = list(probe_checks.doubts(ProbeCalibration(small, probe.scale / 10), SIZE, probe.target_from_image))
    assert said[0] == "the image is 4.99 mm deep: are the poses in mm?"


@pytest.mark.parametrize(("implied", "limits"), [(154.0, SPEEDS), (15400.0, SPEEDS), (1738.0, WATER), (1391.0, WATER)])
def test_a_scale_that_tells_no_speed_of_sound_is_refused(probe, implied, limits):
    """Of no medium where the tank's speed is known otherwise, of no water where it isn't."""
    with pytest.raises(InputError, match=rf"of {limits[0]:g} to {limits[1]:g} m/s, found {implied:.0f}: is rig\.probe\.scale_mm"):
        probe_checks.speed(implied, probe, limits)
    for passing in (1403.0, 1488.0, 1555.0, np.nan):  # m/s, of water from 0 deg C on; unknown
        probe_checks.speed(passing, probe, limits)


def test_a_speed_that_nothing_implies_has_to_be_known(probe):
    with pytest.raises(InputError, match=r"give temperature_c=\.\.\., or rig\.probe\.scale_mm_per_px.*0\.1229 and 0\.1225 mm/px"):
        probe_checks.scanner_scale(np.nan, probe)
    probe_checks.scanner_scale(1488.0, probe)
