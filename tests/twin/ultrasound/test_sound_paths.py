"""Reflection at borders, and what a line meets."""

import numpy as np
import pytest

from twin.ultrasound.sound_paths import reflection


def test_reflection_at_normal_incidence():
    """The impedances alone count: water to steel gives 0.937."""
    assert reflection(1.49, 46.0, 1488.0, 5900.0, 1.0) == pytest.approx((46 - 1.49) / (46 + 1.49))
    assert reflection(1.6, 1.6, 1540.0, 1540.0, 0.3) == pytest.approx(0)


def test_reflection_is_total_beyond_the_critical_angle():
    """Water to acrylic: the critical angle is asin(1488/2700) = 33.4 degrees."""
    below, beyond = (reflection(1.49, 3.2, 1488.0, 2700.0, np.cos(np.deg2rad(angle))) for angle in (30, 35))
    assert 0 < below < 1
    assert beyond == 1


def test_two_fluids_swap_with_the_opposite_sign():
    """Stokes: back through the border, along the refracted ray, the reflection changes its sign."""
    cosine = 0.9
    onwards = np.sqrt(1 - (1450 / 1540) ** 2 * (1 - cosine**2))
    assert reflection(1.6, 1.4, 1540.0, 1450.0, cosine) == pytest.approx(-reflection(1.4, 1.6, 1450.0, 1540.0, onwards))
