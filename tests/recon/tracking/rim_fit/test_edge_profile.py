"""The profile of a blurred and smeared edge, against numerical integration."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import ndtr

from recon.tracking.rim_fit.edge_profile import blurred_step


@pytest.mark.parametrize(("box", "tolerance"), [(0.0, 1e-9), (0.5, 1e-4), (1.19, 1.5e-3), (1.21, 1e-5), (8.0, 1e-5)])
def test_the_profile_is_the_integral(box, tolerance):
    """In units of the blur; a box below 1.2 is taken for Gaussian, tails beyond 4.5 for nothing (3e-6)."""
    blur = 0.7
    wide = blur**2 + (box * blur) ** 2 / 12
    for distance in np.linspace(-6, 6, 41) * blur:
        share, peak = blurred_step(distance, box * blur, blur, wide)
        ends = distance - box * blur / 2, distance + box * blur / 2
        expected = quad(lambda x: ndtr(x / blur), *ends)[0] / (box * blur) if box else ndtr(distance / blur)
        assert share == pytest.approx(expected, abs=tolerance + 4e-6)
        step = 1e-4
        around = [
            quad(lambda x: ndtr(x / blur), ends[0] + s, ends[1] + s, epsabs=1e-13)[0] / (box * blur)
            if box
            else ndtr((distance + s) / blur)
            for s in (-step, step)
        ]
        assert peak == pytest.approx((around[1] - around[0]) / (2 * step), abs=3 * tolerance + 1e-4)
