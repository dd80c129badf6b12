"""Distortion of usual lenses: how large each coefficient may be before anything was seen, and after.

A coefficient counts by the share by which it moves the image's farthest corner towards the middle or away from it. Its standard
deviation among lenses is as likely in each decade up to the largest one below. Given sightings, the weight of each of these
standard deviations follows from the evidence (empirical Bayes), and with it a mean shrinkage towards zero: a coefficient that
points determine feels nothing of it, one that they show to be small is taken as nearly zero, and of one that they don't show only
its scatter among lenses is left. So a rich model costs little where a poor one would do.

Source: MacKay 1992, "Bayesian interpolation" (evidence).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import DISTORTION

Array = NDArray[np.float64]

# Standard deviation of the share in the corner, and the power of the corner's radius that it goes with. Assumed: wide lenses bend
# by 30 %, each further term of a series that converges by less, and decentring and tilt are a maker's tolerances.
LARGEST = {
    "k1": (0.3, 2), "k2": (0.15, 4), "k3": (0.05, 6), "k4": (0.3, 2), "k5": (0.15, 4), "k6": (0.05, 6),
    "p1": (0.02, 1), "p2": (0.02, 1), "s1": (0.02, 1), "s2": (0.02, 3), "s3": (0.02, 1), "s4": (0.02, 3),
    "tau_x": (0.1, 0), "tau_y": (0.1, 0),
}  # fmt: skip
SMALLER = np.geomspace(1e-5, 1, 51)  # times the largest: standard deviations that are thought of
SWEEPS = 4  # over the coefficients, each given the others


def largest(camera: Camera, names: Sequence[str]) -> Array:
    """Largest standard deviation : (g,) of parameters by name among lenses; infinite for those that are no distortion."""
    radius = corner_radius(camera)
    return np.array([share / radius**power for share, power in (LARGEST.get(name, (np.inf, 0)) for name in names)])


def coefficients(camera: Camera, names: Sequence[str]) -> Array:
    """Values : (g,) of parameters by name; zero for those that are no distortion."""
    known = dict(zip(DISTORTION, camera.distortion.tolist(), strict=False))
    return np.array([known.get(name, 0.0) for name in names])


def corner_radius(camera: Camera) -> float:
    """Distance of the image's farthest corner from the optical axis, without distortion, at a distance of 1."""
    middle, corners = camera.matrix[:2, 2], np.array([(0, 0), camera.size]) - 0.5
    return float(np.linalg.norm(np.abs(corners - middle).max(axis=0) / camera.matrix[[0, 1], [0, 1]]))


def estimate(information: Array, pull: Array, start: Array, most: Array) -> Array:
    """Standard deviations : (k,) by which coefficients are held to zero, given what the sightings show of them.

    Parameters
    ----------
    information : (k, k)
        Of the coefficients by the sightings alone, all else eliminated.
    pull : (k,)
        Information times the values that the sightings ask for.
    start : (k,)
        Standard deviations to begin with.
    most : (k,)
        The largest ones among lenses, as `largest`.
    """
    information, pull, sigma = information * np.outer(most, most), pull * most, start / most
    for _ in range(SWEEPS):
        for k in range(len(sigma)):
            posterior = np.linalg.inv(information + np.diag(sigma**-2))
            variance = 1 / max(1 / posterior[k, k] - sigma[k] ** -2, 1e-30)  # by the sightings, given the others
            found = (posterior @ pull)[k] * variance / posterior[k, k]
            sigma[k] = _shrunk(found, variance)
    return sigma * most


def _shrunk(found: float, variance: float) -> float:
    """Standard deviation that shrinks a coefficient as much as those thought of do in the mean, each with its weight."""
    among = SMALLER**2
    evidence = -(np.log(among + variance) + found**2 / (among + variance)) / 2
    weight = np.exp(evidence - evidence.max())
    lost = float(weight @ (variance / (among + variance)) / weight.sum())  # one less the shrinkage, which may be all but one
    return float(np.sqrt(variance * (1 - lost) / lost))
