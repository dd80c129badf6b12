"""Adjustment of a calibration whose bracket may have given, or whose wires may have slipped, by any amount or not at all.

A test finds a movement or doesn't; one too small for it still makes errors. Here nothing moved, the probe did, or the wires
did, evenly or all at once after any frame. Half of a movement, six numbers of the probe or three of the wires, is normal, with
its size as standard deviation. Size and noise aren't known: each course and size is weighed by its evidence, which is the
likelihood integrated over parameters, movement and noise. The outcome is the mean over all of them, and its covariance that of
their mixture, with the movement itself; so the errors that the residuals leave open are in it. Residuals are left + slopes x +
moving h, linear in the parameters x and a movement h; with h ~ N(0, noise^2 size^2) all integrals are closed.

Sources: evidence of a size: MacKay 1992; unknown noise: Gelman 2013; mean over models: Hoeting 1999.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.probe_calibration.movement import Equations

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STILL, GIVES, SLIP = 0.25, 0.5, 0.25  # probability beforehand that nothing moves, the probe does, the wires do; assumed:
# a bracket that carries a probe by hand gives more often than not, and does harm later
EVEN = 0.5  # probability beforehand that a movement is even; else it is sudden, after any frame
LEAST, LARGEST = 0.03, 1.0  # mm and deg along each axis, of half of a movement: less is lost in noise, more is refused
SIZES = np.geomspace(LEAST, LARGEST, 16)  # all as likely beforehand, so that no magnitude is preferred
PROPORTIONS = np.diag([*np.radians(np.ones(3)), *np.ones(3)])  # rad and mm of the probe's turn and shift: 1 deg to 1 mm
NO_NOISE = 1e-12  # sum of squares of residuals that are none


class Rigid(NamedTuple):
    """Least squares of k residuals of frames without a movement."""

    slopes: Array  # (k, g)
    left: Array  # (k,) residuals after the step
    step: Array  # (g,) of the parameters
    inverse: Array  # (g, g) of the normal matrix

    @property
    def freedom(self) -> int:
        """Residuals beyond the unknowns."""
        return len(self.left) - len(self.step)


class Outcomes(NamedTuple):
    """The parameters, if movements are of one kind and course, for s sizes."""

    evidence: Array  # (s,) logarithm, with the probability beforehand, but for a constant of all
    steps: Array  # (s, g)
    covariances: Array  # (s, g, g), with the movement of the probe


def adjusted(equations: Equations, used: Mask, frames: Mask, noise: float = 1.0) -> tuple[Array, Array]:
    """Parameters and their covariance over all movements.

    Parameters
    ----------
    used : (n,)
        Frames whose least squares the equations' solution is.
    frames : (n,)
        Frames to adjust: these, and others that are as right if something moved.
    noise : float
        Standard deviation of the equations' residuals, roughly, by which sizes in mm and deg become those in units of it.

    Returns
    -------
    step : (g,)
        Of the parameters, to those of the middle between both ends.
    covariance : (g, g)
        Of either end, so with the movement of the probe.
    """
    rigid = _rigid(equations, used, frames)
    probe, wires = (np.zeros((len(rigid.step), size)) for size in (6, 3))
    probe[equations.by_probe], wires[equations.by_wires] = PROPORTIONS, np.eye(3)
    still = _outcomes(rigid, rigid.slopes @ probe, probe, np.zeros(1), STILL)
    moving = [
        _outcomes(rigid, np.repeat(course, 3)[:, None] * (rigid.slopes @ by), at_ends, SIZES / noise, chance * share)
        for course, share in _courses(frames)
        for by, at_ends, chance in ((probe, probe, GIVES), (wires, 0 * wires, SLIP))
    ]
    return _mixture([still, *moving])


def _courses(frames: Mask) -> Iterator[tuple[Array, float]]:
    """Courses : (k,) of the k frames from -1 to 1, even or sudden, and the probability of each."""
    number, n = np.flatnonzero(frames), len(frames)
    yield np.linspace(-1, 1, n)[frames], EVEN
    for first in number[1:]:
        yield np.where(number >= first, 1.0, -1.0), (1 - EVEN) / (len(number) - 1)


def _rigid(equations: Equations, used: Mask, frames: Mask) -> Rigid:
    """Of some frames; those used have no slope left, as the equations are at their solution."""
    g, added = equations.slopes.shape[2], frames & ~used
    slopes, left = equations.slopes[frames].reshape(-1, g), equations.residuals[frames].ravel()
    inverse = np.linalg.inv(slopes.T @ slopes + np.diag(equations.known))
    step = -inverse @ equations.slopes[added].reshape(-1, g).T @ equations.residuals[added].ravel()
    return Rigid(slopes, left + slopes @ step, step, inverse)


def _outcomes(rigid: Rigid, moving: Array, at_ends: Array, sizes: Array, chance: float) -> Outcomes:
    """The outcomes for all sizes of movements of one kind and course.

    moving : (k, m)
        Slopes of the residuals by the movement's numbers.
    at_ends : (g, m)
        Change of the parameters at either end by these numbers.
    chance : float
        Probability beforehand of this kind and course.
    """
    pull = rigid.inverse @ rigid.slopes.T @ moving  # of rigid parameters, by the movement
    shown, axes = np.linalg.eigh(moving.T @ (moving - rigid.slopes @ pull))
    shown = np.maximum(shown, 0)  # rounding may make it less
    along = -axes.T @ moving.T @ rigid.left
    ratio = sizes[:, None] ** 2 / (1 + sizes[:, None] ** 2 * shown)  # (s, m) of the movement's variance to the noise's
    rest = np.maximum(rigid.left @ rigid.left - ratio @ along**2, NO_NOISE)
    noise = (rest / (rigid.freedom - 2))[:, None, None]  # variance of Student's t
    growth, spread = (ratio * along) @ axes.T, noise * (axes * ratio[:, None]) @ axes.T
    squared = spread + growth[:, :, None] * growth[:, None]
    covariances = noise * rigid.inverse + pull @ spread @ pull.T + at_ends @ squared @ at_ends.T
    evidence = -(np.log1p(sizes[:, None] ** 2 * shown).sum(axis=1) + rigid.freedom * np.log(rest)) / 2
    return Outcomes(evidence + np.log(chance / len(sizes)), rigid.step - growth @ pull.T, covariances)


def _mixture(outcomes: list[Outcomes]) -> tuple[Array, Array]:
    """Mean : (g,) and covariance : (g, g), each outcome weighed by its evidence."""
    evidence, steps, covariances = (np.concatenate(each) for each in zip(*outcomes, strict=True))
    weights = np.exp(evidence - evidence.max())
    weights /= weights.sum()
    mean = weights @ steps
    around = steps - mean
    return mean, np.tensordot(weights, covariances, 1) + (weights * around.T) @ around
