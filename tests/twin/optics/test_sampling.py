"""Sample points: mirrored exactly, stratified, and different in each pixel."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from twin.optics.sampling import PairedPoints, sobol_pair

PIXELS = 500


def all_samples(draw, samples: int, seed: int = 3) -> np.ndarray:
    """One 2-D dimension of all samples of PIXELS pixels : (PIXELS, samples, 2)."""
    pixel = dr.repeat(dr.arange(mi.UInt32, PIXELS), samples)
    index = dr.tile(dr.arange(mi.UInt32, samples), PIXELS)
    points = draw(PairedPoints(pixel, index, samples, mi.UInt32(seed)))
    return np.asarray(points).T.reshape(PIXELS, samples, 2)


@pytest.mark.parametrize("draw", [PairedPoints.mirrored_square, PairedPoints.mirrored_disc, PairedPoints.mirrored_normal])
def test_pairs_cancel(draw):
    """Samples 2j and 2j+1 are opposite, so that their mean is zero: no common phase shift."""
    points = all_samples(draw, 16)
    np.testing.assert_array_equal(points[:, 0::2], -points[:, 1::2])


@pytest.mark.parametrize("bits", [1, 4, 7])
def test_every_stratum_has_one_point(bits):
    """A scrambled Sobol' set has one point in each of the 2^bits strata of each axis, in every pixel."""
    count = 1 << bits
    seeds = dr.repeat(dr.arange(mi.UInt32, 64), count)
    points = np.asarray(sobol_pair(dr.tile(dr.arange(mi.UInt32, count), 64), bits, seeds)).T.reshape(64, count, 2)
    assert ((points >= 0) & (points < 1)).all()
    for axis in range(2):
        strata = np.sort(np.floor(points[..., axis] * count).astype(int), axis=1)
        assert (strata == np.arange(count)).all()


def test_square_strata():
    """A (0, 2)-sequence also has one point in each of the 4 x 4 squares of 16 points."""
    points = np.asarray(sobol_pair(dr.arange(mi.UInt32, 16), 4, mi.UInt32(5))).T
    assert len({(int(x * 4), int(y * 4)) for x, y in points}) == 16


def test_values_are_uniform():
    """A single sample is uniform over pixels, in mean and variance (5 standard errors)."""
    values = all_samples(PairedPoints.square, 2)[:, 0].ravel()
    assert abs(values.mean() - 0.5) < 5 * np.sqrt(1 / 12 / values.size)
    assert abs(values.var() - 1 / 12) < 5 * np.sqrt(1 / 180 / values.size)


def test_dimensions_are_independent():
    """Two dimensions of the same sample are not correlated (5 standard errors), though both are stratified."""

    def both(points):
        first, second = points.square(), points.square()
        return mi.Point2f(first.x, second.x)

    x, y = all_samples(both, 16).reshape(-1, 2).T
    assert abs(np.corrcoef(x, y)[0, 1]) < 5 / np.sqrt(x.size)


def test_split_points_are_one_larger_set():
    """Two points for each of 8 fill the 16 strata of a larger set, those of each point in different halves, unlike its own."""
    halves = [all_samples(lambda points, k=k: list(points.split(2))[k].square(), 8) for k in range(2)]
    both = np.stack(halves, axis=2)  # (PIXELS, 8, 2, axis)
    strata = np.sort(np.floor(both[..., 0].reshape(PIXELS, 16) * 16).astype(int), axis=1)
    assert (strata == np.arange(16)).all()
    assert (np.floor(2 * both[:, :, 0, 0]) != np.floor(2 * both[:, :, 1, 0])).all()
    own = all_samples(PairedPoints.square, 8)
    assert abs(np.corrcoef(own[..., 0].ravel(), both[:, :, 0, 0].ravel())[0, 1]) < 5 / np.sqrt(8 * PIXELS)


def test_seed_decides():
    """The same seed gives the same points, another seed others."""
    first, again, other = (all_samples(PairedPoints.square, 8, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.99
