"""Standard deviations of frames' errors: they cover the truth, also where errors are none, or are told in part."""

import numpy as np
import pytest

from recon.identification.frame_scatter import scatter


@pytest.mark.parametrize("truth", [0.0, 0.005, 0.02])
@pytest.mark.parametrize("frames", [8, 16])
def test_intervals_cover_the_truth(rng, truth, frames):
    """Intervals of 95 % hold the truth in 90 % or more of 300 draws; 16 errors tell it to a quarter or so.

    The mean can't be seen, and the measurement's own noise is 0.004.
    """
    middle = np.eye(frames) - np.full((frames, frames), 1 / frames)
    information = middle / 0.004**2
    found = []
    for _ in range(300):
        errors = truth * rng.standard_normal(frames) + 0.004 * rng.standard_normal(frames)
        found.append(scatter(information, information @ errors, 0.2))
    values, sigmas = np.array([one[:2] for one in found]).T
    assert np.mean(np.abs(values - truth) < 1.96 * sigmas) > 0.9
    if truth == 0.02:
        assert 0.9 < np.median(values) / truth < 1.25
        assert np.median(sigmas) < (0.35 if frames == 16 else 0.7) * truth


def test_few_modes_say_so():
    """Of eight errors two are told."""
    information = np.diag([1e6, 1e6, 1, 1, 1, 1, 1, 1.0])
    found = scatter(information, information @ np.full(8, 0.01), 0.2)
    assert found.modes < 2.1
