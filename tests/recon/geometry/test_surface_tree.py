"""The nearest of a surface's points, against all of them one by one."""

import numpy as np
from scipy.spatial.distance import cdist

from recon.geometry.surface_tree import surface_tree


def test_the_nearest_is_the_nearest(rng):
    """From afar, from beside the surface, and from its points themselves."""
    x, y = rng.uniform(-20, 20, (2, 2000))
    points = np.column_stack([x, y, 0.01 * x * x - 0.02 * x * y])
    raised = np.array([0.0, 0.0, 15.0])
    places = np.concatenate([points[:50] + raised, points[50:100] + rng.normal(0, 1, (50, 3)), points[100:110]])
    distance, nearest = surface_tree(points).query(places)
    every = cdist(places, points)
    assert (nearest == every.argmin(axis=1)).all()
    assert np.allclose(distance, every.min(axis=1))
