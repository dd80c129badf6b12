"""Shape of a board: tolerances by which it may differ from its design, as the sightings themselves show them.

A board is imprecise in four ways: each dot is printed off its place, the whole print is stretched or sheared, the board bows
(along x, along y, as a twist), and each dot stands out by its own. Each way has one standard deviation. The sightings of many
poses show the deviations themselves; the standard deviations follow from these by the evidence: the probability of the sightings
when deviations are drawn with them (empirical Bayes). Those of a flat board come out as the little that sightings can't exclude.
A common scale leaves no trace in the sightings: it stays the design's, and is as uncertain as aspect and shear, which leave one,
show the print to be. Departures are those from a board of that scale, in the prior as in the evidence: else a smaller board,
whose departures are smaller as well, would be the likelier one.

Source: MacKay 1992, "Bayesian interpolation" (evidence).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SIGMAS_MM = np.geomspace(1e-4, 1.0, 81)  # tolerances that are thought of, each decade as likely as the next
SAME_SCALE = 1e-6  # relative: to how much the board's scale is held to the design's
SWEEPS = 4  # over the four tolerances, each given the others
WAYS = ("print_mm", "stretch_mm", "bow_mm", "dent_mm")


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of a board's departures from its design, mm."""

    print_mm: float = 0.0  # of each point along x and y
    stretch_mm: float = 0.0  # of the whole print by its scale, its aspect and its shear, each: RMS over the points
    bow_mm: float = 0.0  # of each of the three ways of bowing: RMS over the points
    dent_mm: float = 0.0  # of each point out of the plane
    determined: float | None = None  # coordinates of points that the sightings determine, of 3 n; None if all but the pose's six

    def covariance(self, design: Array) -> Array:
        """Covariance : (3 n, 3 n) mm^2 of all points' coordinates, for a board of that design : (n, 3) mm."""
        ways, which = departures(design)
        scaled = ways * self.sigmas[which]
        return scaled @ scaled.T

    def information(self, design: Array) -> Array:
        """Information : (3 n, 3 n) 1/mm^2 of a board of the design's scale; tolerances of each point above zero.

        That of the tolerances, and an exact scale, as generalised least squares measure it.
        """
        known = np.linalg.inv(self.covariance(design))
        larger = (design - design.mean(axis=0)).ravel()
        scale = known @ larger / (larger @ known @ larger)  # of departures from the design
        return known + np.outer(scale, scale) / SAME_SCALE**2

    def scale_sigma(self, design: Array) -> float:
        """Standard deviation of the scale : a ratio; of a board : (n, 3) mm that is as large as its design in the mean."""
        if not self.sigmas[0] > 0:
            return float(self.stretch_mm / np.sqrt(np.mean(np.sum((design - design.mean(axis=0)) ** 2, axis=1))))
        larger = (design - design.mean(axis=0)).ravel()
        return float(1 / np.sqrt(larger @ np.linalg.solve(self.covariance(design), larger)))

    @property
    def sigmas(self) -> Array:
        """The four standard deviations : (4,) mm, in the order of WAYS."""
        return np.array([getattr(self, way) for way in WAYS])


AS_DESIGNED = Tolerances()
WIDE = Tolerances(0.1, 0.1, 1.0, 0.3)  # of a board of which nothing is known


def departures(design: Array) -> tuple[Array, NDArray[np.intp]]:
    """Unit departures : (3 n, 3 n + 6) of a board : (n, 3) mm, and the place of each one's standard deviation among WAYS."""
    n = len(design)
    smooth = np.hstack([_stretches(design), bends(design)])
    return np.hstack([np.eye(3 * n), smooth]), np.concatenate([np.tile([0, 0, 3], n), np.repeat([1, 2], 3)])


def bends(design: Array) -> Array:
    """An arch along x, a twist and an arch along y of a board : (n, 3) mm, each of RMS 1 mm : (3 n, 3) mm."""
    x, y = ((design - design.mean(axis=0)) / (np.ptp(design, axis=0) / 2 + 1e-9)).T[:2]
    none = np.zeros(len(design))
    return _unit([np.column_stack([none, none, bow]) for bow in (x**2, x * y, y**2)])


def _stretches(design: Array) -> Array:
    """A larger print, a longer and narrower one, and a sheared one : (3 n, 3) mm, of RMS 1 mm."""
    x, y = (design - design.mean(axis=0)).T[:2]
    none = np.zeros(len(design))
    return _unit([np.column_stack(way) for way in ((x, y, none), (x, -y, none), (y, x, none))])


def _without_scale(ways: Array, design: Array) -> Array:
    """Departures : (3 n, k) less what they change of the scale of a design : (n, 3) mm, by least squares."""
    larger = (design - design.mean(axis=0)).ravel()
    return ways - np.outer(larger, larger @ ways) / (larger @ larger)


def _unit(ways: Sequence[Array]) -> Array:
    """Displacements, each (n, 3) mm, scaled to an RMS of 1 mm, side by side."""
    return np.stack([each.ravel() / np.sqrt(np.mean(np.sum(each**2, axis=1)) + 1e-30) for each in ways], axis=1)


def estimate(information: Array, pull: Array, design: Array, given: Tolerances) -> Tolerances:
    """Tolerances by the evidence, those that are given (above zero) as they are.

    Each is the mean over those thought of, weighed by the probability that they give to the sightings.

    Parameters
    ----------
    information : (3 n, 3 n), 1/mm^2
        Of the points' coordinates by the sightings alone, poses and devices eliminated.
    pull : (3 n,), 1/mm
        Information times the departures from the design that the sightings ask for.
    """
    ways, which = departures(design)
    ways = _without_scale(ways, design)
    gram, along = ways.T @ information @ ways, ways.T @ pull
    sigmas = np.where(given.sigmas > 0, given.sigmas, WIDE.sigmas)
    for _ in range(SWEEPS):
        for way in np.flatnonzero(given.sigmas == 0):
            evidence = _evidence(which == way, sigmas[which], gram, along)
            weight = np.exp(evidence - evidence.max())
            sigmas[way] = weight @ SIGMAS_MM / weight.sum()
    scaled = sigmas[which]
    left = np.linalg.inv(np.eye(len(scaled)) + scaled[:, None] * gram * scaled)
    return replace(Tolerances(*sigmas.tolist()), determined=float(len(scaled) - np.trace(left)))


def _evidence(own: NDArray[np.bool_], scale: Array, gram: Array, along: Array) -> Array:
    """Logarithm of the probability of the sightings, up to a constant, at each of SIGMAS_MM of the departures `own` : (m,) bool.

    The others have standard deviations scale : (m,) mm, and are integrated out.
    """
    others = scale[~own]
    mixed = others[:, None] * np.column_stack([gram[~own][:, own], along[~own]])
    taken = mixed.T @ np.linalg.solve(np.eye(len(others)) + others[:, None] * gram[np.ix_(~own, ~own)] * others, mixed)
    values, vectors = np.linalg.eigh(gram[np.ix_(own, own)] - taken[:-1, :-1])
    told, variance = vectors.T @ (along[own] - taken[:-1, -1]), SIGMAS_MM[:, None] ** 2
    widened = 1 + variance * np.maximum(values, 0)
    return np.sum(variance * told**2 / widened - np.log(widened), axis=1) / 2
