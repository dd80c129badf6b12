"""Reduced rows of lens models far from the points."""

import numpy as np
import pytest

from tests.twin.experiments.asked import rows
from twin.experiments import lens_accuracy


@pytest.mark.parametrize(("distortion", "first"), [("auto", 1), pytest.param("rational", 0, marks=pytest.mark.slow)])
def test_lenses_are_sound_and_honest_all_over_the_image(distortion, first):
    """Six point sets of a dozen, in which each place meets each number of poses once; the rows are those of 200."""
    found = [lens_accuracy.each(seed, distortion) for seed in range(first, 12, 2)]
    assert all(one.one_to_one for one in found)
    assert np.mean([one.inside for one in found]) > 0.8


def test_rows_tell_the_point_sets_that_there_are(monkeypatch):
    """Not those that are asked for, where there are fewer seeds."""
    monkeypatch.setattr(lens_accuracy, "SEEDS", range(3))
    monkeypatch.setattr(lens_accuracy, "each", lambda seed, lenses: lens_accuracy.Judged(0.95, True))
    found = lens_accuracy.far_from_points(None, "auto", 200)
    assert rows(lens_accuracy.far_from_points, found, lenses="auto")[0].what.startswith("3 point sets, auto lenses: ")
