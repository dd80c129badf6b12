"""Least squares by damped Gauss-Newton steps, for problems whose equations are built in a way of their own.

Source: Levenberg 1944; Marquardt 1963 for the damping by tens. SciPy's `least_squares` serves where a plain Jacobian is enough.
"""

from collections.abc import Callable
from typing import Generic, NamedTuple, Protocol, TypeVar

Estimate = TypeVar("Estimate")
Step = TypeVar("Step")
SomeStep = TypeVar("SomeStep", covariant=True)

LEAST_DAMPING, LAST_DAMPING = 1e-4, 1e8  # after the first step uphill, and where there is no way down
ROUNDING = 1e-14  # of the cost at the start: a rise that says nothing of the way


class Rules(NamedTuple):
    """Where to begin and to end."""

    damping: float = 1e-4  # of the first step; 0 is a Gauss-Newton step
    rounding: float = 0.0  # rise of the cost that is not taken for a step uphill
    converged: float = 1e-10  # relative change of the cost; 0 leaves the end to `settled`
    steps: int = 50  # at most, those uphill included


USUAL = Rules()


class Unreachable(ValueError):
    """A step that can not be solved for, or that leads to an estimate that can not be: a shorter one may."""


class LinearSystem(Protocol[SomeStep]):
    """A problem linearised at an estimate, as of `recon.estimation.equations`."""

    def step(self, damping: float) -> SomeStep:
        """Solve with the diagonal times `1 + damping`; may raise `Unreachable`, and anything else ends the descent."""
        ...


System = TypeVar("System", bound=LinearSystem)


class Descent(NamedTuple, Generic[Estimate, System, Step]):
    """The outcome."""

    estimate: Estimate  # of least cost
    system: System  # the problem linearised there
    step: Step | None  # the first step that was settled, not taken; None where the cost converged or steps ran out
    converged: bool  # a step was settled, or the cost stayed; else steps ran out, or none led down though the equations say so


def descend(
    start: Estimate,
    linearise: Callable[[Estimate], tuple[System, float]],
    move: Callable[[Estimate, Step], Estimate],
    settled: Callable[[System, Step], bool] = lambda system, step: False,
    rules: Rules = USUAL,
) -> Descent[Estimate, System, Step]:
    """Descend from an estimate to the next minimum of a cost.

    Parameters
    ----------
    linearise : estimate -> (system, cost)
        The equations, and the sum of squares.
    move : estimate, step -> estimate
        Take a step. `Unreachable`, raised by this or by the equations, counts as a step uphill.
    settled : system, step -> bool
        Whether a step is so short that nothing is gained by taking it.
    """
    estimate, damping, converged = start, rules.damping, False
    system, cost = linearise(estimate)
    first = cost
    for _ in range(rules.steps):
        if converged or damping > LAST_DAMPING:
            break
        try:
            step = system.step(damping)
            if settled(system, step):
                return Descent(estimate, system, step, True)
            trial = move(estimate, step)
        except Unreachable:
            damping = max(10 * damping, LEAST_DAMPING)
            continue
        following, new = linearise(trial)
        if new < cost + rules.rounding:
            converged = abs(cost - new) < rules.converged * cost
            estimate, system, cost, damping = trial, following, new, damping / 10
        else:  # of a wrong slope a short step rises as little as it is short
            converged = (new - cost) * max(1, damping) < rules.converged * cost
            damping = max(10 * damping, LEAST_DAMPING)
            converged = converged or (damping > LAST_DAMPING and new - cost <= ROUNDING * first)
    return Descent(estimate, system, None, converged)
