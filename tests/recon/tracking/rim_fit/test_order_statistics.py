"""Quantiles of those that count, against NumPy's."""

import numpy as np
import pytest

from recon.tracking.rim_fit.order_statistics import count, quantile


@pytest.mark.parametrize("share", [0.0, 0.5, 0.75, 1.0])
def test_quantiles_are_those_of_numpy(rng, share):
    """Of an odd and an even number, some of them equal."""
    for size in range(1, 49):
        values, counted = np.round(rng.normal(size=48), 1), np.arange(48) < size
        rng.shuffle(counted)
        assert quantile(values, counted, share) == pytest.approx(np.quantile(values[counted], share), rel=1e-14, abs=1e-14)
        assert count(counted) == size


def test_nothing_has_no_quantile():
    assert np.isnan(quantile(np.ones(5), np.zeros(5, bool), 0.5))
