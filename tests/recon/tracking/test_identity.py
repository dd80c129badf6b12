"""Candidates become triples, or pairs with one circle unseen, that can be the target."""

import numpy as np
import pytest

from recon.tracking import identity
from recon.tracking.circle_detector import Candidates
from tests.recon.tracking import drawings


@pytest.fixture
def centres(rig, rng):
    return drawings.shown(rig.cam1.optics.camera(), drawings.facing(rng), rig.target).centre


def candidates(points, names):
    """Sure of their names as a network is."""
    points = np.asarray(points, float).reshape(-1, 2)
    return Candidates(points, np.full(len(points), 0.8), 0.05 + 0.8 * np.eye(4)[list(names)])


def test_the_likeliest_triple_is_that_of_the_names(centres, rig, rng):
    beside = np.vstack([centres, rng.uniform(0, 1000, (4, 2))])
    found = identity.namings(candidates(beside, (0, 1, 2, 3, 3, 3, 3)), rig.target, 1280)
    np.testing.assert_array_equal(found[0].points, centres)
    assert sorted((each.score for each in found), reverse=True) == [each.score for each in found]


@pytest.mark.parametrize("unseen", [0, 1, 2])
def test_two_candidates_leave_one_unseen(centres, rig, unseen):
    names = [k for k in range(3) if k != unseen]
    found = identity.namings(candidates(centres[names], names), rig.target, 1280)
    expected = centres.copy()
    expected[unseen] = np.nan
    np.testing.assert_array_equal(found[0].points, expected)
    whole = identity.namings(candidates(centres, range(3)), rig.target, 1280)[0]
    assert found[0].within(whole) and not whole.within(found[0])


def test_with_fewer_or_far_apart_there_is_none(centres, rig):
    for count in (0, 1):
        assert not identity.namings(candidates(centres[:count], range(count)), rig.target, 1280)
    assert not identity.namings(candidates([[100, 100], [1200, 900]], (0, 1)), rig.target, 1280)
