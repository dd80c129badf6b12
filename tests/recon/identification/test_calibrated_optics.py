"""Optics of a rig as calibrated: of a device that a calibration leaves out, what was measured before stays."""

import numpy as np
import pytest

from recon.identification import calibrated_optics, rig_file
from recon.model.calibration import Calibration, Uncertainty


def calibrated(rig, devices, variance: float) -> Calibration:
    """Some of the rig's devices, whose focal lengths have a variance, and half of it in common."""
    names = tuple(f"{device}.fx" for device in devices)
    covariance = variance * (np.eye(len(names)) + np.ones((len(names),) * 2)) / 2
    cameras = {device: getattr(rig, device).optics.camera() for device in devices}
    return Calibration(cameras, Uncertainty(names, covariance, has_scale=True))


def identified(rig, calibration):
    return rig_file.apply(calibrated_optics.with_devices(rig, calibration), calibrated_optics.findings(calibration))


def test_a_device_that_is_left_out_keeps_its_covariance(rig):
    """As if independent of the new ones."""
    first = identified(rig, calibrated(rig, ("cam1", "cam2", "projector"), 4.0))
    second = identified(first, calibrated(rig, ("cam1", "projector"), 1.0))
    known = second.optics_covariance
    assert known.names == ("cam1.fx", "projector.fx", "cam2.fx")
    assert known.matrix() == pytest.approx(np.array([[1.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 4.0]]))
    assert second.measured["cam2.optics.focal_px.0"].sigma == 2 and second.measured["cam1.optics.focal_px.0"].sigma == 1


@pytest.mark.parametrize("part", ["projector", "projector.optics", "projector.optics.focal_px.0", "projector.gamma"])
def test_what_is_changed_is_not_measured_any_more(rig, part):
    """Nor is the covariance of all optics known, if it is one of them."""
    known = identified(rig, calibrated(rig, ("cam1", "cam2", "projector"), 4.0)).unmeasured(part)
    optics = part != "projector.gamma"
    assert (known.optics_covariance is None) == optics
    assert ("projector.optics.focal_px.0" in known.measured) != optics and "cam2.optics.focal_px.0" in known.measured
    assert known.unmeasured() == known
