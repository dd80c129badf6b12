"""Least squares by damped Gauss-Newton steps, for problems whose equations are built, and solved, in a way of their own.

Source: Levenberg 1944; Marquardt 1963 for the damping by tens. SciPy's `least_squares` serves where a plain Jacobian is enough.
"""

from collections.abc import Callable
from math import inf
from typing import Generic, NamedTuple, TypeVar

Estimate = TypeVar("Estimate")
System = TypeVar("System")
Step = TypeVar("Step")

LEAST_DAMPING, LAST_DAMPING = 1e-4, 1e8  # after the first step uphill, and where there is no way down


class Rules(NamedTuple):
    """Where to begin and to end."""

    damping: float = 1e-4  # of the first step; 0 is a Gauss-Newton step
    rounding: float = 0.0  # rise of the cost that is not taken for a step uphill
    converged: float = 1e-10  # relative change of the cost; 0 leaves the end to `settled`
    steps: int = 50  # at most, those uphill included


USUAL = Rules()


class Unreachable(ValueError):
    """A step that can not be solved for, or that leads to an estimate that can not be: a shorter one may."""


class Descent(NamedTuple, Generic[Estimate, System, Step]):
    """The outcome."""

    estimate: Estimate  # of least cost
    system: System  # the problem linearised there
    step: Step | None  # the first step that was settled, not taken; None where the cost converged or steps ran out
    converged: bool  # a step was settled, the cost stayed, or the shortest step led uphill; else steps ran out or led nowhere


def descend(
    start: Estimate,
    linearised: Callable[[Estimate], tuple[System, float]],
    solved: Callable[[Estimate, System, float], Step],
    moved: Callable[[Estimate, Step], Estimate],
    settled: Callable[[System, Step], bool] = lambda system, step: False,
    rules: Rules = USUAL,
) -> Descent[Estimate, System, Step]:
    """Descend from an estimate to the next minimum of a cost.

    Parameters
    ----------
    linearised : estimate -> (system, cost)
        The equations, in any form that `solved` takes, and the sum of squares.
    solved : estimate, system, damping -> step
        Solve the equations with their diagonal times `1 + damping`.
    moved : estimate, step -> estimate
        Take a step. `Unreachable`, raised by `solved` or `moved`, counts as a step uphill.
    settled : system, step -> bool
        Whether a step is so short that nothing is gained by taking it.
    """
    estimate, damping, converged = start, rules.damping, False
    system, cost = linearised(estimate)
    for _ in range(rules.steps):
        if converged or damping > LAST_DAMPING:
            break
        try:
            step = solved(estimate, system, damping)
            if settled(system, step):
                return Descent(estimate, system, step, True)
            trial = moved(estimate, step)
        except Unreachable:
            damping = max(10 * damping, LEAST_DAMPING)
            continue
        following, new = linearised(trial)
        converged = abs(cost - new) < rules.converged * cost
        if new < cost + rules.rounding:
            estimate, system, cost, damping = trial, following, new, damping / 10
        else:
            damping = max(10 * damping, LEAST_DAMPING)
            converged = converged or (damping > LAST_DAMPING and new < inf)
    return Descent(estimate, system, None, converged)
