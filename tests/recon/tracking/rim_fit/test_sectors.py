"""Sectors of a rim: their geometry, levels, weights and noise, against plain versions."""

import numpy as np
import pytest

from recon.tracking.rim_fit import sectors
from recon.tracking.rim_fit.rim_parameters import Rim
from recon.tracking.rim_fit.sectors import BRIGHT, DARK, LEVELS, SECTORS, SUMS, UNKNOWNS, SideNoise
from tests.recon.tracking.rim_fit import plain_rims

RIM = Rim(60.3, 58.8, 40.0, 3.0, 36.0, 20.0, 1.0, -2.0, 120.0, 8.0, 5.0, 4.0, 2.0, -1.5)


@pytest.mark.parametrize("reach", [0.0, 9.0])
@pytest.mark.parametrize("motion", [(0.0, 0.0), (2.0, -1.5), (-0.5, 0.1)])
def test_geometry_is_that_of_the_plain_version(motion, reach):
    rim = RIM._replace(variance_cos=motion[0], variance_sin=motion[1])
    found, expected = sectors.geometry(rim, reach, 0.4), plain_rims.geometry(rim, reach, 0.4)
    for name in sectors.SECTOR.names:
        np.testing.assert_allclose(found[name], expected[name], atol=1e-9, err_msg=name)


def test_the_variance_turns_with_the_normal():
    """V = v0 + v1 cos 2phi + v2 sin 2phi, of the motion's box and the lens together."""
    geometry = sectors.geometry(RIM, 0.0, 0.4).view(np.recarray)
    expected = RIM.variance + RIM.variance_cos * geometry.cos + RIM.variance_sin * geometry.sin
    np.testing.assert_allclose(geometry.wide, expected)


def test_each_direction_lies_in_its_sector(rng):
    directions = rng.normal(size=(1000, 2))
    found = [sectors.sector(x, y) for x, y in directions]
    np.testing.assert_allclose(found, plain_rims.sector_number(directions), atol=1e-12)
    geometry = sectors.geometry(RIM, 0.0, 0.4)
    middles = [sectors.sector(x, y) for x, y in zip(geometry["ux"], geometry["uy"], strict=True)]
    np.testing.assert_allclose(middles, np.arange(SECTORS) + 0.5, atol=1e-12)


@pytest.fixture
def sums(rng):
    """Sums : of 40 pixels a sector, with sector 5 empty and sector 9 dark alone; and the pixels' shares and residuals."""
    share = np.clip(rng.uniform(-0.5, 1.5, (SECTORS, 40)), 0, 1)
    share[9] = 0
    residual = rng.normal(size=share.shape) * np.sqrt(9 + (36 - 9) * share)
    robust = np.ones_like(share)
    robust[5] = 0
    slopes = rng.normal(size=(SECTORS, 40, UNKNOWNS))
    slopes[:, :, DARK], slopes[:, :, BRIGHT] = 1 - share, share
    weighted = robust[:, :, None] * slopes
    sums = np.zeros(SECTORS, SUMS)
    sums["normal"], sums["right"] = np.einsum("jim,jin->jmn", weighted, slopes), np.einsum("jim,ji->jm", weighted, residual)
    for name, each in (
        ("squares", residual**2 / (9 + 27 * share)),
        ("count", np.ones_like(share)),
        ("dark2", (1 - share) ** 2),
        ("mixed", share * (1 - share)),
        ("bright2", share**2),
        ("dark_squares", (1 - share) * residual**2),
        ("bright_squares", share * residual**2),
    ):
        sums[name] = (robust * each).sum(axis=1)
    return sums


def test_free_levels_are_each_sectors_own_solution(sums):
    free = sectors.free_levels(sums)
    for j in range(SECTORS):
        normal = sums["normal"][j][np.ix_([DARK, BRIGHT], [DARK, BRIGHT])] * (1 + 0.001 * np.eye(2))
        if j in (5, 9):
            assert (free.dark[j], free.bright[j], free.dark_variance[j], free.bright_variance[j]) == (0, 0, 0, 0)
            continue
        solution = np.linalg.solve(normal, sums["right"][j, [DARK, BRIGHT]])
        np.testing.assert_allclose([free.dark[j], free.bright[j]], solution)
        np.testing.assert_allclose([free.dark_variance[j], free.bright_variance[j]], np.diag(np.linalg.inv(normal)))


def test_weights_fall_with_misfit_and_contrast(sums, rng):
    geometry, own = sectors.geometry(RIM, 0.0, 0.4), np.zeros(SECTORS, LEVELS)
    own["bright"][20:24] = -100.0  # no contrast
    sums["squares"][30] *= 20
    weights = np.full(SECTORS, np.nan)
    usual = sectors.weigh(sums, geometry, RIM, own, 4, weights)

    free = sectors.free_levels(sums)
    dark = RIM.dark + RIM.dark_x * geometry["x"] + RIM.dark_y * geometry["y"] + free.dark
    bright = RIM.bright + RIM.bright_x * geometry["x"] + RIM.bright_y * geometry["y"] + own["bright"] + free.bright
    contrast = (bright - dark) / (bright + dark)
    filled = sums["count"] >= 4
    likely = filled & (contrast > sectors.STEEP * np.quantile(contrast[filled], 0.75))
    np.testing.assert_array_equal(sectors.steep(dark, bright, filled), likely)
    assert not likely[[5, 20, 21, 22, 23]].any() and likely.sum() > 40
    mean = sums["squares"][likely] / sums["count"][likely]
    assert usual == pytest.approx(np.median(mean))
    np.testing.assert_allclose(weights[likely], (1 + (mean / (sectors.STRANGE * usual)) ** 2) ** -2.0)
    assert not weights[~likely].any()
    assert weights[30] < 0.2 < 0.8 < np.median(weights)


def test_too_little_of_a_rim_has_no_weights(sums):
    geometry, own, weights = sectors.geometry(RIM, 0.0, 0.4), np.zeros(SECTORS, LEVELS), np.ones(SECTORS)
    assert sectors.weigh(sums, geometry, RIM, own, 41, weights) == 0
    sums["count"][sectors.LEAST_SECTORS - 1 :] = 0
    assert sectors.weigh(sums, geometry, RIM, own, 4, weights) == 0


def test_noise_of_both_sides_is_that_of_least_squares(sums, rng):
    """Squared residuals, by their shares of both sides, are a straight line in the two variances."""
    weights = rng.random(SECTORS)
    found = sectors.side_noise(sums, weights, SideNoise(1.0, 1.0))
    a, b, c = (weights @ sums[name] for name in ("dark2", "mixed", "bright2"))
    squares = np.array([weights @ sums["dark_squares"], weights @ sums["bright_squares"]]) / sectors.KEPT
    np.testing.assert_allclose(found, np.linalg.solve([[a, b], [b, c]], squares))
    np.testing.assert_allclose(found, [9, 36], rtol=0.2)
    sums["dark_squares"] = 0
    assert sectors.side_noise(sums, weights, SideNoise(1.0, 1.0)).dark == sectors.ROUNDING
    assert sectors.even_noise(SideNoise(2.0, 4.0), 1.5) == (4.5, 4.5)
    assert sectors.even_noise(SideNoise(2.0, 4.0), 1e-9) == (sectors.ROUNDING, sectors.ROUNDING)
