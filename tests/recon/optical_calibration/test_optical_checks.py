"""Warnings of a calibration that looks like none of a rig's devices."""

import numpy as np
import pytest

from recon.geometry.camera import Camera
from recon.optical_calibration.optical_checks import stretch


@pytest.mark.parametrize(("fx", "sigma", "said"), [(1540.0, 1e-3, True), (1921.0, 1e-3, False), (1540.0, 0.1, False)])
def test_a_stretched_display_is_said(fx, sigma, said):
    """A projector whose display is scaled from 1024 to 1280 columns; the rig's own; and one that is hardly known."""
    camera = Camera((1280, 800), np.array([[fx, 0, 614.0], [0, 1927.0, 772.0], [0, 0, 1]]), np.zeros(5))
    warning = stretch("projector", camera, sigma)
    assert (warning is not None) == said
    assert warning is None or "projector: focal lengths fx / fy are 0.80" in warning
