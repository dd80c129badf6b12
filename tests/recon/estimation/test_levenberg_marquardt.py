"""The loop of Levenberg and Marquardt, against closed forms and SciPy."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from recon.estimation.equations import Rows
from recon.estimation.levenberg_marquardt import Rules, Unreachable, descend

numbers = st.floats(-5, 5)


def valley(p):
    """Rosenbrock's: a narrow, bent valley with its end at (1, 1)."""
    return np.array([10 * (p[1] - p[0] ** 2), 1 - p[0]]), np.array([[-20 * p[0], 10.0], [-1.0, 0.0]])


def linearise(p):
    residual, jacobian = valley(p)
    return Rows(jacobian, -residual), residual @ residual


@given(numbers, numbers)
def test_the_end_of_a_bent_valley_is_found(x, y):
    """One start in 150 takes more than 50 steps."""
    found = descend(np.array([x, y]), linearise, np.add, rules=Rules(steps=500)).estimate
    assert np.abs(found - 1).max() < 1e-4


def test_the_minimum_is_scipys(rng):
    """Of an exponential with noise, where residuals stay: to the change of a parameter that a cost's 1e-10 is worth."""
    time = np.linspace(0, 3, 40)
    values = 2 * np.exp(-1.3 * time) + rng.normal(0, 0.05, 40)

    def residuals(p):
        return p[0] * np.exp(-p[1] * time) - values

    def both(p):
        jacobian = np.column_stack([np.exp(-p[1] * time), -p[0] * time * np.exp(-p[1] * time)])
        return Rows(jacobian, -residuals(p)), float(residuals(p) @ residuals(p))

    found = descend(np.array([1.0, 0.5]), both, np.add)
    expected = least_squares(residuals, [1.0, 0.5], xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    assert np.abs(found.estimate - expected).max() < 1e-5
    assert found.converged and found.step is None


@given(numbers, numbers)
def test_the_cost_never_rises(x, y):
    costs = []

    def recorded(p):
        system, cost = linearise(p)
        costs.append(cost)
        return system, cost

    found = descend(np.array([x, y]), recorded, np.add)
    assert linearise(found.estimate)[1] == min(costs)


def test_a_step_to_nowhere_is_shortened():
    """Where an estimate can not be, the damping grows until the step ends short of it."""

    def fenced(p, step):
        if np.abs(step).max() > 0.5:
            raise Unreachable("too far")
        return p + step

    assert np.abs(descend(np.array([-1.2, 1.0]), linearise, fenced).estimate - 1).max() < 1e-6


@pytest.mark.parametrize("mistake", [ValueError("matmul: shapes"), np.linalg.LinAlgError("SVD did not converge")])
@pytest.mark.parametrize("place", ["step", "move"])
def test_a_mistake_is_no_step_uphill(place, mistake):
    """Wrong shapes, and equations of values that are not finite, end the descent with their own message."""

    def wrong(*_):
        raise mistake

    class Wrong(NamedTuple):
        step = wrong

    equations, move = ((lambda p: (Wrong(), 1.0)), np.add) if place == "step" else (linearise, wrong)
    with pytest.raises(type(mistake), match=str(mistake)):
        descend(np.array([-1.2, 1.0]), equations, move)


def test_a_settled_step_is_handed_on_and_not_taken():
    """Of a line the first step of Gauss and Newton leads to the solution, and the second is none."""
    design, values = np.column_stack([np.ones(5), np.arange(5.0)]), np.array([1.0, 2.9, 5.1, 7.0, 9.0])
    found = descend(
        np.zeros(2),
        lambda p: (Rows(design, values - design @ p), float(np.sum((design @ p - values) ** 2))),
        np.add,
        settled=lambda system, step: bool(np.abs(step).max() < 1e-9),
        rules=Rules(damping=0, converged=0, rounding=1e-12),
    )
    assert found.estimate == pytest.approx(np.linalg.lstsq(design, values)[0])
    assert found.step is not None and np.abs(found.step).max() < 1e-9 and found.converged


def test_a_minimum_that_rounding_hides_has_converged():
    """From the minimum itself, at a cost of zero that no relative change can be measured by."""
    found = descend(np.array([1.0, 1.0]), linearise, np.add)
    assert found.converged and (found.estimate == 1).all()


@pytest.mark.parametrize("rest", [0.0, 1.0, 100.0])
def test_slopes_of_the_wrong_sign_have_not_converged(rest):
    """All steps lead uphill, and the shorter ones by ever less, whether or not the cost at its minimum is much of it."""

    def wrong(p):
        return Rows(np.array([[-1.0], [0.0]]), np.array([-p[0], rest])), float(p @ p + rest**2)

    found = descend(np.array([3.0]), wrong, np.add)
    assert not found.converged and found.estimate == 3.0


def test_steps_run_out():
    found = descend(np.array([-4.0, 4.0]), linearise, np.add, rules=Rules(steps=2))
    assert found.step is None and not found.converged


def test_where_no_way_leads_down_nothing_has_converged():
    """Steps that all lead nowhere, by shape or by cost: the start is handed back."""

    def nowhere(p, step):
        raise Unreachable("no estimate there")

    def lost(p, step):
        return p + np.nan

    for moved in (nowhere, lost):
        found = descend(np.array([-1.2, 1.0]), linearise, moved)
        assert not found.converged and (found.estimate == [-1.2, 1.0]).all()
