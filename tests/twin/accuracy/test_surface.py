"""The rows of the accuracy tables, as far as they are quick, and the statistic for surfaces without truth."""

import numpy as np
import pytest

from twin.accuracy import optics, surface


def check(rows) -> None:
    """Every bar is met."""
    assert not [row for row in rows if not row.ok]


@pytest.mark.parametrize("pose", [0, 4])
def test_planes_of_the_paper(rig, pose):
    """Nearest and farthest plane: RMS within 1.25 of what noise allows, errors as large as predicted."""
    check(surface.planes(rig, pose))


def test_sphere_of_the_paper(rig):
    """Radius within 0.02 mm, RMS within 0.04 mm."""
    check(surface.sphere(rig))


def test_breast(rig):
    """Coverage, RMS, and hardly a point off by more than 1 mm."""
    check(surface.breast(rig))


def test_no_wrong_order_survives(rig):
    """Deep steps and shadows: no point on a wrong order, and what the centre line doesn't reach is said to be so."""
    check(surface.orders_under_stress(rig))


def test_real_relief():
    """A recording of others: enough points, in the right depth, and sigma as large as the local residual."""
    folder = surface.real_folder()
    if folder is None:
        pytest.skip("no real recordings; SONOTWIN_REAL names their folder")
    check(surface.real_capture(folder))


@pytest.mark.parametrize(("name", "coefficients"), [("realistic", optics.REALISTIC_14), ("strong", optics.STRONG_14)])
def test_round_trip(name, coefficients):
    """Pixel to ray to pixel through all 14 coefficients, everywhere in the image."""
    check([optics.round_trip(name, coefficients)])


@pytest.mark.parametrize("told", [1.0, 0.5])
def test_noise_is_told_from_shape(rng, told):
    """On a curved surface with known noise the ratio is that of the noise to what sigma claims (3 %)."""
    v, u = np.mgrid[:300, :400]
    distance = np.float32(650 + 2e-4 * (u - 200) ** 2 + 1e-4 * u * v + rng.normal(0, 0.05, u.shape))
    ratio = surface.smooth_noise_ratio(distance, np.full(u.shape, 0.05 * told, np.float32))
    assert ratio == pytest.approx(1 / told, rel=0.03)


def test_gaps_are_left_out(rng):
    """Patches with a hole don't count, whatever is in the hole's place."""
    distance = np.float32(650 + rng.normal(0, 0.05, (90, 90)))
    distance[10, 10] = np.nan
    ratio = surface.smooth_noise_ratio(distance, np.full(distance.shape, 0.05, np.float32))
    assert ratio == pytest.approx(1, rel=0.1)
