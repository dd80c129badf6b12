"""Reduced rows of lens models far from the points."""

import numpy as np
import pytest

from twin.accuracy import lens_accuracy


@pytest.mark.parametrize("distortion", ["auto", "rational"])
def test_lenses_are_sound_and_honest_all_over_the_image(distortion):
    """A dozen point sets, each place and number of poses once; the rows are those of 200."""
    found = [lens_accuracy.each(seed, distortion) for seed in range(12)]
    assert all(one.one_to_one for one in found)
    assert np.mean([one.inside for one in found]) > 0.8
