"""Warnings of a calibration that looks like none of a rig's devices."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from recon.geometry.camera import Camera
from recon.optical_calibration.optical_checks import coverage, measuring_part, stretch


@pytest.mark.parametrize(("fx", "sigma", "said"), [(1540.0, 1e-3, True), (1921.0, 1e-3, False), (1540.0, 0.1, False)])
def test_a_stretched_display_is_said(fx, sigma, said):
    """A projector whose display is scaled from 1024 to 1280 columns; the rig's own; and one that is hardly known."""
    camera = Camera((1280, 800), np.array([[fx, 0, 614.0], [0, 1927.0, 772.0], [0, 0, 1]]), np.zeros(5))
    warning = stretch("projector", camera, sigma)
    assert (warning is not None) == said
    assert warning is None or "projector: focal lengths fx / fy are 0.80" in warning


@pytest.mark.parametrize(("k1", "part"), [(0.0, 0.25), (-2.0, 1.0)])
def test_a_projector_whose_lens_folds_before_the_cameras_corners_counts_as_a_whole(k1, part):
    """Else the part that camera 1 sees: here a middle of half its width and height, and of points all over the image as much."""
    size, middle = (1280, 720), (639.5, 359.5)
    camera, projector = (
        Camera(size, np.array([[f, 0, middle[0]], [0, f, middle[1]], [0, 0, 1]]), np.array([k, 0, 0, 0, 0]))
        for f, k in ((1000.0, 0.0), (500.0, k1))
    )
    cameras = {"cam1": camera, "projector": projector}
    adjustment: Any = SimpleNamespace(
        calibration=SimpleNamespace(cameras=cameras), points=np.array([[0.0, 0, 0], [100, 0, 0]]), poses=np.eye(4)[None]
    )
    adjustment.poses[:, 2, 3] = 600
    corners = measuring_part(adjustment, "projector")
    assert np.isfinite(corners).all()
    assert np.prod(np.ptp(corners, axis=0)) == pytest.approx(part * 1280 * 720, rel=0.01)
    assert coverage(corners, corners) == pytest.approx(1)
