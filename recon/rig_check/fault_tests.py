"""Tests of faults on linear equations with normal errors: which of several parts has moved, if any, and which can't be told
apart.

Measured are residuals `y = F_h d_h + H e + n`: the motion d_h of a part h, free; errors e of the calibration, with their
covariance C; and noise n of variance 1. A part is tested by the generalised likelihood ratio, the squared length of its estimated
motion in standard deviations: chi-square with as many degrees of freedom as its motion has where nothing moved, so that an error
that the calibration admits is no alarm. Which part moved is told by the evidence, in which a motion has a usual size: a part of
more freedom explains more, and has to (MacKay 1992, Bayesian interpolation).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]

RIVAL = np.log(20.0)  # of evidence, below the best one's: another part that may be it
UNSEEN = 1e-6  # of the largest eigenvalue: a direction of motion that measurements don't show
SMALLEST = -600.0  # logarithm of a chance, below which numbers have no digits left
WORTH = 200  # degrees of freedom that a prediction of the noise is worth, where noise is smaller than predicted
MOST_NAMED = 3  # parts: beyond, all is to be calibrated anew anyway


@dataclass(frozen=True)
class Fault:
    """A part that may have moved."""

    slopes: Array  # (m, k) of the residuals by its motion
    usual: Array  # (k,) size of a usual motion, in its units


@dataclass(frozen=True)
class Equations:
    """Residuals and what they may be made of, all in standard deviations of their noise."""

    residuals: Array  # (m,)
    spread: Array  # (m, j) by independent standard normal numbers: what is uncertain, and not tested
    faults: Mapping[str, Fault]
    daily: Array | None = None  # (m, d) the same of what is other each day, such as usual drift, for charts over days


@dataclass(frozen=True)
class Finding:
    """The outcome for one part."""

    sigma: float  # of a normal number as unlikely as the motion found, had nothing moved
    freedom: int
    motion: Array  # (k,) most likely one, of usual size
    covariance: Array  # (k, k) of it
    usual: Array  # (k,) as of the fault
    own: Array  # (k, k) covariance of the motion found where nothing moved, by noise and what is other each day
    common: Array  # (k, k) the same by the spread, which may be the same in the next check
    named: bool  # whether it is told to have moved
    rivals: tuple[str, ...] = ()  # that explain all as well


class _Test(NamedTuple):
    finding: Finding
    evidence: float  # logarithm, over that of nothing having moved
    statistic: float  # squared length of the motion in standard deviations: twice the logarithm of the largest likelihood ratio


def unexplained(equations: Equations, used: NDArray[np.bool_]) -> Array:
    """Residuals : (m,) that no error and no motion explains, whatever their sizes, as fitted to those of a mask : (m,)."""
    explained = _scaled(equations)
    return equations.residuals - explained @ np.linalg.lstsq(explained[used], equations.residuals[used], UNSEEN)[0]


def noise_factor(equations: Equations) -> float:
    """Standard deviation of the residuals that no error and no motion explains, over the predicted one.

    Where it is smaller, the prediction counts as so many equations more (a conjugate prior).
    """
    explained = _scaled(equations)
    freedom = len(explained) - int(np.linalg.matrix_rank(explained, rtol=UNSEEN))
    if freedom < 1:
        return 1.0
    left = unexplained(equations, np.ones(len(explained), bool))
    found = float(left @ left)
    return float(np.sqrt(found / freedom if found > freedom else (found + WORTH) / (freedom + WORTH)))


def _scaled(equations: Equations) -> Array:
    """Slopes : (m, p) by all errors and motions, of unit length."""
    slopes = np.column_stack([equations.spread, *(fault.slopes for fault in equations.faults.values())])
    length = np.linalg.norm(slopes, axis=0)
    return slopes[:, length > 0] / length[length > 0]


def find(equations: Equations, alarm_sigma: float) -> dict[str, Finding]:
    """Test all parts. While some are beyond `alarm_sigma` the likeliest of these is named, and the others are tested beside it.

    Its rivals are as likely, within RIVAL, by their evidence and by their best fit: a part that explains nothing has lost little
    evidence either, if its freedom is small.

    Returns
    -------
    By part; those that no equation shows are left out.
    """
    found: dict[str, Finding] = {}
    seen = {name: fault for name, fault in equations.faults.items() if np.abs(fault.slopes).max(initial=0) > 0}
    equations = replace(equations, faults=seen)
    while True:
        tests = {name: _tested(equations, fault) for name, fault in equations.faults.items()}
        beyond = [name for name, test in tests.items() if test.finding.sigma > alarm_sigma]
        if len(found) == MOST_NAMED or not beyond:
            return found | {name: test.finding for name, test in tests.items()}
        best = max(beyond, key=lambda name: tests[name].evidence)
        least, fit = tests[best].evidence - RIVAL, tests[best].statistic - 2 * RIVAL
        rivals = tuple(name for name, one in tests.items() if name != best and one.evidence > least and one.statistic > fit)
        found[best] = replace(tests[best].finding, named=True, rivals=rivals)
        motion = equations.faults[best].slopes * (10 * equations.faults[best].usual)  # uncertain, and not tested any more
        others = {name: fault for name, fault in equations.faults.items() if name != best}
        spread, daily = (
            motion if each is None else np.column_stack([each, motion]) for each in (equations.spread, equations.daily)
        )
        equations = Equations(equations.residuals, spread, others, daily)


def _tested(equations: Equations, fault: Fault) -> _Test:
    """Test a part by itself."""
    slopes = fault.slopes * fault.usual
    weighed = _weighed(equations, slopes)
    information, right = weighed.T @ slopes, weighed.T @ equations.residuals
    information = (information + information.T) / 2
    values, axes = np.linalg.eigh(information)
    shown = values > UNSEEN * values.max()
    statistic = float(np.sum((axes[:, shown].T @ right) ** 2 / values[shown]))
    posterior = np.linalg.inv(information + np.eye(len(right)))
    motion = posterior @ right
    evidence = 0.5 * float(right @ motion - np.sum(np.log1p(np.maximum(values, 0))))
    freedom, sizes = int(shown.sum()), fault.usual
    covariance = posterior * np.outer(sizes, sizes)
    response = sizes[:, None] * posterior @ weighed.T  # of the motion by the residuals
    daily = np.zeros((len(response), 0)) if equations.daily is None else response @ equations.daily
    own, common = (each @ each.T for each in (np.column_stack([response, daily]), response @ equations.spread))
    finding = Finding(as_sigma(statistic, freedom), freedom, sizes * motion, covariance, sizes, own, common, named=False)
    return _Test(finding, evidence, statistic)


def _weighed(equations: Equations, slopes: Array) -> Array:
    """Slopes : (m, k) times the inverse covariance of the residuals where nothing moved."""
    spread = equations.spread
    return slopes - spread @ np.linalg.solve(np.eye(spread.shape[1]) + spread.T @ spread, spread.T @ slopes)  # Woodbury


def best_chance(equations: Equations, part: str, motion: Array, alarm_sigma: float) -> float:
    """Chance at which a motion : (k,) is found by a test that knows its direction: no unbiased test finds it more often.

    Source: Neyman & Pearson 1936, of tests unbiased to both sides.
    """
    effect = equations.faults[part].slopes @ motion
    sigma = float(np.sqrt(effect @ _weighed(equations, effect[:, None])[:, 0]))
    return float(stats.norm.sf(alarm_sigma - sigma) + stats.norm.sf(alarm_sigma + sigma))


def as_sigma(statistic: float, freedom: int) -> float:
    """Standard deviations of a normal number that is as seldom as large, either way, as chi-square is as large as a statistic."""
    chance = float(stats.chi2.logsf(statistic, freedom))
    return float(stats.norm.isf(np.exp(chance) / 2)) if chance > SMALLEST else float(np.sqrt(statistic))


def moved_parts(findings: Mapping[str, Finding]) -> Sequence[str]:
    """Names of moved parts and their rivals."""
    return list(dict.fromkeys(one for name, each in findings.items() if each.named for one in (name, *each.rivals)))
