"""Movement of the probe against its target, or of the wires, while the B-scans of a calibration are taken.

A bracket gives under its load, wires are pushed or sag: then the crossing isn't at one place in all frames. Either is described
by its growth from the first frame to the last, linear in the frame's number (a sudden one has three quarters of its variance so):
six numbers of the bracket, three of the wires. Squared residuals that fall by more with them than by noise, as F has it, show a
movement. The parameters then are those of the middle of the session, estimated along with it.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

Array = NDArray[np.float64]

CHANCE = 1e-3  # of so much less residuals by noise alone, below which something moved
RATHER = 100.0  # times as likely must the wires' movement be to be believed: a bracket's that isn't seen does harm
SUSPECTED = 0.02  # the same, below which a movement can't be excluded
LEAST_FREEDOM = 12  # numbers measured beyond the unknowns; with fewer a movement can't be separated from noise
PROBE, WIRES = "probe", "wires"


class Equations(NamedTuple):
    """Whitened equations of the adjustment, at its solution, of n frames in the order in which they were taken."""

    slopes: Array  # (n, 3, g) of the residuals by the parameters
    residuals: Array  # (n, 3)
    by_probe: slice  # parameters of the probe's turn and shift against its target
    by_wires: slice  # and of the wires' place


@dataclass(frozen=True)
class Movement:
    """What moved between the first frame and the last."""

    what: str  # PROBE or WIRES
    growth: Array  # (6,) rad and mm of the probe's pose, or (3,) mm of the wires' place: half of the movement
    growth_covariance: Array  # (6, 6) or (3, 3)
    step: Array  # (g,) of the parameters, to those of the middle of the session
    covariance: Array  # (g, g) of the parameters, with the noise that is left
    chance: float  # of so much less residuals by noise alone

    @property
    def sure(self) -> bool:
        """Whether something moved; else it can't be excluded."""
        return self.chance < CHANCE

    @property
    def shift_mm(self) -> float:
        """From the first frame to the last."""
        return 2 * float(np.linalg.norm(self.growth[-3:]))

    @property
    def turn_deg(self) -> float:
        """The same of the probe; 0 of wires."""
        return 2 * float(np.degrees(np.linalg.norm(self.growth[:-3])))


def find(equations: Equations) -> Movement | None:
    """The likelier movement of the two; None where noise explains the residuals as well."""
    candidates = [_fitted(equations, what, which) for what, which in ((PROBE, equations.by_probe), (WIRES, equations.by_wires))]
    likely = [one for one in candidates if one is not None and one.chance < SUSPECTED]
    return min(likely, key=lambda one: one.chance * (RATHER if one.what == WIRES else 1.0), default=None)


def _fitted(equations: Equations, what: str, which: slice) -> Movement | None:
    """The movement by least squares, and the chance of as good a fit by noise."""
    n, _, g = equations.slopes.shape
    time = np.linspace(-1, 1, n)[:, None, None]
    still = equations.slopes.reshape(-1, g)
    moving = np.concatenate([equations.slopes, time * equations.slopes[:, :, which]], axis=2).reshape(3 * n, -1)
    freedom, more = 3 * n - moving.shape[1], moving.shape[1] - g
    if freedom < LEAST_FREEDOM:
        return None
    left = equations.residuals.ravel()
    before, _ = _rest(still, left)
    after, solution = _rest(moving, left)
    ratio = (before - after) / more / (after / freedom)
    covariance = np.linalg.inv(moving.T @ moving) * after / freedom
    chance = float(f_distribution.sf(ratio, more, freedom))
    return Movement(what, -solution[g:], covariance[g:, g:], -solution[:g], covariance[:g, :g], chance)


def _rest(design: Array, left: Array) -> tuple[float, Array]:
    """The least sum of squares of `left - design x`, and x."""
    solution = np.linalg.lstsq(design, left)[0]
    return float(np.sum((left - design @ solution) ** 2)), solution
