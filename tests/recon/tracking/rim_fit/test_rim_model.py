"""The sums of a rim's fit: their right sides are slopes of the squares that they add up."""

import numpy as np
import pytest

from recon.tracking.rim_fit import rim_model, sectors
from recon.tracking.rim_fit.sectors import BLUR, BRIGHT, DARK, GROWTH, LOCAL, OWN, PULL, RIGHT, SECTORS, SQUARES, WIDE

HOLE = 0.4
ELLIPSE = np.array([60.3, 58.8, 40.0, 3.0, 36.0])  # px: centre, shape
VARIANCE = np.array([1.3, 0.0, 0.0])  # px^2: no motion
PLANES = np.array([20.0, 1.0, -2.0, 120.0, 8.0, 5.0])  # DN
NOISE = np.full(2, 1e8)  # DN^2, in which no pixel is an outlier


@pytest.fixture
def sums_of(rng):
    """Sums : (LOCAL,) over all sectors of a picture of noise, for their own levels and geometry."""
    image = rng.uniform(0, 200, (120, 120)).astype(np.float32)

    def summed(own, geometry):
        sums = np.zeros((SECTORS, LOCAL))
        rim_model._add_up(image, ELLIPSE, PLANES, own, NOISE, geometry, 1, HOLE, sums)
        return sums.sum(axis=0)

    return summed


@pytest.mark.parametrize(("level", "unknown"), [(DARK, 1), (BRIGHT, 2), (GROWTH, 4)])
def test_sums_are_slopes_by_own_levels(sums_of, rng, level, unknown):
    geometry = sectors.geometry(ELLIPSE, VARIANCE, 0.0, HOLE)
    own = rng.normal(0, [5, 5, 0.5, 2], (SECTORS, OWN))
    below, above = own.copy(), own.copy()
    below[:, level] -= 0.01
    above[:, level] += 0.01
    slope = (sums_of(above, geometry) - sums_of(below, geometry))[SQUARES] / 0.02
    assert -2 * sums_of(own, geometry)[RIGHT + unknown] == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize(("column", "unknown", "sign"), [(PULL, 0, -1), (WIDE, 3, 1)])
def test_sums_are_slopes_by_place_and_variance_of_the_edge(sums_of, column, unknown, sign):
    """A pull inwards by so much is an edge that lies inwards by it. Light that changes across the edge is taken to stay."""
    geometry = sectors.geometry(ELLIPSE, VARIANCE, 0.0, HOLE)
    own = np.zeros((SECTORS, OWN))
    changed = []
    for step in (-1e-3, 1e-3):
        other = geometry.copy()
        other[:, column] += step
        other[:, BLUR] = np.sqrt(other[:, WIDE])
        changed.append(sums_of(own, other)[SQUARES])
    slope = sign * (changed[1] - changed[0]) / 2e-3
    assert -2 * sums_of(own, geometry)[RIGHT + unknown] == pytest.approx(slope, rel=2e-2)
