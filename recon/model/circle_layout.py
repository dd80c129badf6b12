"""Where the target's circles lie, by three lengths and a bow, and how well the lengths are known.

The frame is the circles' own: c0 its origin, c1 on the x axis, c2 in the plane z = 0. Three points have three lengths: c1 along
x; c2 along x, which is 0 by design, and along y.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.model.rig import Target

Array = NDArray[np.float64]

LENGTHS = ("c1_mm", "c2_aside_mm", "c2_mm")
BY_LENGTH = np.zeros((3, 3, 3))  # derivatives of (circle, axis) by the three lengths
BY_LENGTH[1, 0, 0] = BY_LENGTH[2, 0, 1] = BY_LENGTH[2, 1, 2] = 1
COUNT = len(BY_LENGTH)  # of circles; whoever needs the number takes it from here
NEGLIGIBLE = 1e-12  # of a variance, mm^2


def lengths(target: Target) -> Array:
    """The three lengths : (3,) mm, in the order of LENGTHS."""
    return np.array([target.c1_mm, target.c2_aside_mm, target.c2_mm])


def circle_centres(target: Target) -> Array:
    """Centres : (3, 3) mm of the circles in the target's frame."""
    return BY_LENGTH @ lengths(target)


def extent(target: Target) -> Array:
    """Largest x and y : (2,) mm of the circles' centres; the smallest are those of c0."""
    return circle_centres(target)[:, :2].max(axis=0)


def middle(target: Target) -> Array:
    """Place : (3,) mm in the target's frame about which the circles lie."""
    return np.append(extent(target), 0.0) / 2


class Circles(NamedTuple):
    """Circles' outer rims in the target's frame, as `recon.geometry.circle_outline.ellipses_of` takes them."""

    centres: Array  # (n, 3) mm
    radius_mm: float
    slopes: Array  # (n, 2) dz/dx, dz/dy of their planes

    def some(self, which: NDArray[np.bool_]) -> "Circles":
        """Those of `which` : (n,)."""
        return self._replace(centres=self.centres[which], slopes=self.slopes[which])


def circles(target: Target) -> Circles:
    """The outer rims of all circles."""
    return laid_out(lengths(target), target.outer_diameter_mm, np.array(target.curvature_per_m))


def laid_out(lengths_mm: Array, diameter_mm: float, curvature_per_m: Array) -> Circles:
    """Circles of three lengths : (3,) on a board of the curvature : (3,) xx, xy, yy.

    The board is `z = (xx x^2 + 2 xy x y + yy y^2) / 2`, less the plane through the three centres.
    """
    (c1, aside, c2), (xx, xy, yy) = lengths_mm.tolist(), (1e-3 * curvature_per_m).tolist()
    places = ((0.0, 0.0), (c1, 0.0), (aside, c2))
    _, first, second = (x * (xx * x + xy * y) / 2 + y * (xy * x + yy * y) / 2 for x, y in places)
    by_x = first / c1
    by_y = (second - by_x * aside) / c2
    slopes = [(xx * x + xy * y - by_x, xy * x + yy * y - by_y) for x, y in places]
    return Circles(np.array([(*place, 0.0) for place in places]), diameter_mm / 2, np.array(slopes))


def length_covariance(target: Target) -> Array:
    """Covariance : (3, 3) mm^2 of the lengths: as measured, or of circles each printed to a tolerance along both axes."""
    if target.covariance_mm2 is not None:
        return np.array(target.covariance_mm2)
    aside, along = target.c2_aside_mm / target.c1_mm, target.c2_mm / target.c1_mm
    by_place = np.array([  # columns: x and y of c0, c1, c2; where c1 is off in y, the axes turn
        [-1, 0, 1, 0, 0, 0],
        [-1, -along, 0, along, 1, 0],
        [0, aside - 1, 0, -aside, 0, 1],
    ])  # fmt: skip
    return target.tolerance_mm**2 * by_place @ by_place.T


def deviations(target: Target) -> Array:
    """Displacements : (3, 3, k) mm of (circle, axis) by k standard normal numbers, as the lengths' covariance has it."""
    variances, axes = np.linalg.eigh(length_covariance(target))
    kept = variances > NEGLIGIBLE
    return BY_LENGTH @ (axes[:, kept] * np.sqrt(variances[kept]))
