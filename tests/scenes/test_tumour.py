"""Tumours: exact size, closed, lobulated."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from scenes.mass_forms import mass
from scenes.tumour import caliper, tumour


@settings(max_examples=20, deadline=None)
@given(size=st.floats(3, 60), seed=st.integers(0, 2**31))
def test_a_tumour_is_closed_and_of_the_asked_size(size, seed):
    mesh = tumour(size, np.random.default_rng(seed))
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    # against an independent measure: the extent along 2000 directions never exceeds the size and comes near it
    directions = np.random.default_rng(0).standard_normal((2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    extent = np.ptp(mesh.vertices @ directions.T, axis=0).max()
    assert 0.99 * size < extent <= size * (1 + 1e-9)


def test_the_caliper_is_the_largest_of_all_distances():
    points = np.random.default_rng(3).standard_normal((300, 3))
    assert caliper(points) == pytest.approx(pdist(points).max())
    for form in ("round", "spiculated"):  # whose points nearly all lie as far out, and hardly any
        body = mass(form, 13.0, np.random.default_rng(3)).vertices * [1, 0.97, 0.9]
        assert caliper(body) == pdist(body[ConvexHull(body).vertices]).max()


@pytest.mark.parametrize("seed", range(5))
def test_a_tumour_is_lobulated(seed):
    """A convex mass fills its hull; lobes leave hollows between them, yet it stays one mass."""
    mesh = tumour(20.0, np.random.default_rng(seed))
    assert 0.85 < mesh.volume / mesh.convex_hull.volume < 0.995


def test_tumours_of_one_seed_are_one_and_of_two_seeds_differ():
    first, again, other = (tumour(20.0, np.random.default_rng(seed)).vertices for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.5
