"""Where the target's circles lie, by lengths and a bow, and how well the lengths are known.

The frame is the circles' own: c0 its origin, c1 on the x axis, all in the plane z = 0 but for the bow. n circles have 2 n - 3
lengths: c1 along x; then of each further one its place along x, called aside, and along y. Their number is that of the target's
kind, a module of `recon.model.targets`.
"""

from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.model.rig import Target

Array = NDArray[np.float64]

NEGLIGIBLE = 1e-12  # of a variance, mm^2


def count(target: Target | type[Target]) -> int:
    """Number of circles of a target, or of a kind."""
    return (len(target.LENGTHS) + 3) // 2


def names(target: Target) -> tuple[str, ...]:
    """Names of the circles, c0 and on."""
    return tuple(f"c{k}" for k in range(count(target)))


def lengths(target: Target) -> Array:
    """The lengths : (2 n - 3,) mm."""
    return np.array([getattr(target, name) for name in target.LENGTHS])


def lengths_between(places: Array) -> Array:
    """Lengths : (2 n - 3,) mm of circles at places : (n, 2) mm, wherever their frame is."""
    x, *sides = places[1:] - places[0]
    c1 = float(np.linalg.norm(x))
    return np.array([c1, *(length for side in sides for length in (side @ x / c1, (x[0] * side[1] - x[1] * side[0]) / c1))])


def with_lengths(target: Target, values: Array) -> Target:
    """The target with other lengths : (2 n - 3,) mm."""
    return target.model_copy(update=dict(zip(target.LENGTHS, values.tolist(), strict=True)))


@cache
def _by_length(circles: int) -> Array:
    slopes = np.zeros((circles, 3, 2 * circles - 3))
    slopes[1, 0, 0] = 1
    for k in range(2, circles):
        slopes[k, 0, 2 * k - 3] = slopes[k, 1, 2 * k - 2] = 1
    return slopes


def _fixed(values: Array) -> Array:
    """The array itself, which can't be written to any more."""
    values.setflags(write=False)
    return values


def by_length(target: Target) -> Array:
    """Derivatives : (n, 3, 2 n - 3) of the circles' places by the lengths."""
    return _by_length(count(target))


@lru_cache
def circle_centres(target: Target) -> Array:
    """Centres : (n, 3) mm of the circles in the target's frame; not to be written to."""
    return _fixed(by_length(target) @ lengths(target))


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


@lru_cache
def circles(target: Target) -> Circles:
    """The outer rims of all circles; not to be written to."""
    centres, radius_mm, slopes = laid_out(lengths(target), target.outer_diameter_mm, np.array(target.curvature_per_m))
    return Circles(_fixed(centres), radius_mm, _fixed(slopes))


def laid_out(lengths_mm: Array, diameter_mm: float, curvature_per_m: Array) -> Circles:
    """Circles of lengths : (2 n - 3,) on a board of the curvature : (3,) xx, xy, yy.

    The board is `z = (xx x^2 + 2 xy x y + yy y^2) / 2`, less the plane through the centres of c0, c1 and c2.
    """
    c1, *others = lengths_mm.tolist()
    (xx, xy, yy), places = (
        (1e-3 * curvature_per_m).tolist(),
        [(0.0, 0.0), (c1, 0.0), *zip(others[::2], others[1::2], strict=True)],
    )
    heights = [x * (xx * x + xy * y) / 2 + y * (xy * x + yy * y) / 2 for x, y in places]
    aside, c2 = places[2]
    by_x = heights[1] / c1
    by_y = (heights[2] - by_x * aside) / c2
    off = [0.0] * 3 + [z - by_x * x - by_y * y for (x, y), z in zip(places[3:], heights[3:], strict=True)]
    slopes = [(xx * x + xy * y - by_x, xy * x + yy * y - by_y) for x, y in places]
    return Circles(np.column_stack([places, off]), diameter_mm / 2, np.array(slopes))


def length_covariance(target: Target) -> Array:
    """Covariance : (2 n - 3, 2 n - 3) mm^2 of the lengths: as measured, or of circles printed to a tolerance."""
    if target.covariance_mm2 is not None:
        return np.array(target.covariance_mm2)
    places = circle_centres(target)[:, :2]
    by_place = np.zeros((len(target.LENGTHS), 2 * len(places)))  # columns: x and y of each; c1 off in y turns the axes
    by_place[0, [0, 2]] = -1, 1
    for k, (aside, along) in enumerate((places[2:] / places[1, 0]).tolist(), start=2):
        row = 2 * k - 3
        by_place[row, [0, 1, 3, 2 * k]] = -1, -along, along, 1
        by_place[row + 1, [1, 3, 2 * k + 1]] = aside - 1, -aside, 1
    return target.tolerance_mm**2 * by_place @ by_place.T


@lru_cache
def deviations(target: Target) -> Array:
    """Displacements : (n, 3, k) mm of (circle, axis) by k standard normal numbers, as the lengths' covariance has it; not to be
    written to.
    """
    variances, axes = np.linalg.eigh(length_covariance(target))
    kept = variances > NEGLIGIBLE
    return _fixed(by_length(target) @ (axes[:, kept] * np.sqrt(variances[kept])))
