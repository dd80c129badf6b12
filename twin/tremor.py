"""Physiological tremor of a hand, which leads a probe or a target: a Gaussian process of 8 to 12 Hz.

Source: Elble & Koller 1990, Tremor: the hand's own is of 8 to 12 Hz, by the motor units' firing, about alike in all directions.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HZ = (8.0, 12.0)
WAVES = 32  # of evenly spread frequencies, which make up the process


@dataclass(frozen=True)
class Tremor:
    """Six processes over time: a turn (rad) about three axes, and a shift (mm) along them."""

    hz: Array  # (WAVES,)
    cosines: Array  # (6, WAVES)
    sines: Array  # (6, WAVES)

    def at(self, seconds: float) -> Array:
        """Turn and shift : (6,)."""
        angle = 2 * np.pi * self.hz * seconds
        return self.cosines @ np.cos(angle) + self.sines @ np.sin(angle)

    def rate(self, seconds: float) -> Array:
        """Their derivatives : (6,) rad/s and mm/s."""
        angle = 2 * np.pi * self.hz * seconds
        return self.sines @ (2 * np.pi * self.hz * np.cos(angle)) - self.cosines @ (2 * np.pi * self.hz * np.sin(angle))


def draw(turn_deg: float, shift_mm: float, *key: int) -> Tremor:
    """Draw a tremor of standard deviations in each axis, the same for the same key."""
    rng = np.random.default_rng(key)
    hz = np.linspace(*HZ, WAVES) + (HZ[1] - HZ[0]) / WAVES * rng.uniform(-0.5, 0.5, WAVES)
    size = np.repeat([np.deg2rad(turn_deg), shift_mm], 3)[:, None] / np.sqrt(WAVES)
    cosines, sines = size * rng.standard_normal((2, 6, WAVES))
    return Tremor(hz.clip(*HZ), cosines, sines)
