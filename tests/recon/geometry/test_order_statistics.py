"""Quantiles against NumPy's."""

import numpy as np
import pytest

from recon.geometry.order_statistics import count, quantile, quantile_of


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 0.75, 1.0])
def test_quantiles_are_those_of_numpy(rng, share):
    """Of odd and even numbers of values, many of them equal, in any order."""
    for size in (*range(1, 20), 500, 4001):
        for values in (rng.normal(size=size), np.round(rng.normal(size=size), 1), np.arange(size) * 1.0, -np.arange(size) * 1.0):
            assert quantile(values.copy(), share) == pytest.approx(np.quantile(values, share), rel=1e-12, abs=1e-14)


def test_quantiles_of_those_that_count(rng):
    values, counted = rng.normal(size=48), rng.random(48) < 0.6
    assert quantile_of(values, counted, 0.75) == pytest.approx(np.quantile(values[counted], 0.75))
    assert count(counted) == counted.sum()


def test_nothing_has_no_quantile():
    assert np.isnan(quantile(np.empty(0), 0.5))
    assert np.isnan(quantile_of(np.ones(5), np.zeros(5, bool), 0.5))


def test_values_that_are_not_numbers_do_no_harm(rng):
    """They may come out, but neither stop the search nor lead out of the array."""
    for _ in range(200):
        values = np.where(rng.random(9) < 0.4, np.nan, rng.normal(size=9))
        found = quantile(values.copy(), 0.5)
        assert np.isnan(found) or np.nanmin(values) <= found <= np.nanmax(values)
