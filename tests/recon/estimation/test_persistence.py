"""Do residuals that repeat count once?"""

import numpy as np
import pytest

from recon.estimation.persistence import persistence


@pytest.mark.parametrize("columns", [2, 3, 18])
def test_frames_that_repeat_count_once(columns, rng):
    """Each residual ten times is one; independent ones count each."""
    independent = rng.standard_normal((300, columns))
    assert persistence(independent) < 1.5
    assert persistence(np.repeat(independent, 10, axis=0)) == pytest.approx(10, rel=0.3)


def test_a_sum_of_neighbours_counts_as_its_mean_varies(rng):
    """Of a moving sum the variance of the mean is known: five terms, 5 frames count as one."""
    noise = rng.standard_normal((4000, 2))
    moving = np.stack([np.convolve(column, np.ones(5), "valid") for column in noise.T], axis=1)
    assert persistence(moving) == pytest.approx(5, rel=0.15)
