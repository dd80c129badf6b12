"""Smooth random fields, for skin relief, mottled colour and wood grain."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

Array = NDArray[np.float64]
Seed = Annotated[int, Field(ge=0)]


def smooth_noise(points: Array, wavelength: float, rng: np.random.Generator, waves: int = 64) -> Array:
    """A smooth random field of zero mean and unit variance at points : (n, d), as (n,).

    A sum of plane waves of random direction and phase, with wavelengths from 0.6 to 1.6 times `wavelength`, in the points'
    unit. Nearly Gaussian; the same points in another order give the same values.
    """
    direction = rng.standard_normal((waves, points.shape[1]))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    wave = 2 * np.pi / (wavelength * rng.uniform(0.6, 1.6, (waves, 1))) * direction
    phase = rng.uniform(0, 2 * np.pi, waves)
    total = np.zeros(len(points))
    for k in range(waves):  # one wave at a time: memory stays that of the points
        total += np.cos(points @ wave[k] + phase[k])
    return total * np.sqrt(2 / waves)
