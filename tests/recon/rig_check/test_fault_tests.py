"""Parts that moved are found and named by their equations; errors that the calibration admits are no alarm."""

from dataclasses import replace

import numpy as np
import pytest

from recon.rig_check import fault_tests
from recon.rig_check.fault_tests import Equations, Fault


@pytest.fixture
def equations(rng) -> Equations:
    """Forty measurements, three uncertain parameters, and two parts of six and of two motions."""
    faults = {
        "first": Fault(rng.standard_normal((40, 6)), np.full(6, 10.0)),
        "second": Fault(rng.standard_normal((40, 2)), np.full(2, 10.0)),
    }
    return Equations(np.zeros(40), 30 * rng.standard_normal((40, 3)), faults)


def measured(equations: Equations, rng, motion=(), part="first") -> Equations:
    """Noise of 1, errors of the calibration, and a motion."""
    residuals = rng.standard_normal(40) + equations.spread @ rng.standard_normal(3)
    slopes = equations.faults[part].slopes
    return Equations(residuals + slopes[:, : len(motion)] @ np.array(motion), equations.spread, equations.faults)


def test_alarms_are_as_seldom_as_they_claim(equations, rng):
    """Beyond 2 sigma 4.6 % of 1000 checks, for each part, to 5 standard deviations of a count, with errors 30 times the noise."""
    sigmas = np.array([[one.sigma for one in fault_tests.find(measured(equations, rng), 50.0).values()] for _ in range(1000)])
    assert (sigmas > 2).mean(axis=0) == pytest.approx(0.0455, abs=5 * np.sqrt(0.0455 / 1000))


def test_the_motion_found_varies_as_told_from_day_to_day_and_from_rig_to_rig(equations, rng):
    """On 200 days of one rig, on each of which one more uncertain number is drawn anew, and of 200 rigs of other calibrations.

    Whitened squares sum to six in the mean, to 5 standard deviations; the days' mean is the calibration's error.
    """
    day, error, found = rng.standard_normal((40, 1)), rng.standard_normal(3), {"days": [], "rigs": []}
    for _ in range(200):
        for name, errors in (("days", error), ("rigs", rng.standard_normal(3))):
            residuals = rng.standard_normal(40) + equations.spread @ errors + day @ rng.standard_normal(1)
            found[name].append(fault_tests.find(replace(equations, residuals=residuals, daily=day), 50.0)["first"])
    one = found["days"][0]
    for name, covariance in (("days", one.own), ("rigs", one.own + one.common)):
        motions = np.array([each.motion for each in found[name]])
        left = motions - (motions.mean(axis=0) if name == "days" else 0.0)
        squares = np.einsum("ni,ni->n", left, np.linalg.solve(covariance, left.T).T)
        assert squares.mean() == pytest.approx(6, abs=5 * np.sqrt(12 / 200))


@pytest.mark.parametrize("part", ["first", "second"])
def test_what_moved_is_named_and_its_motion_found(equations, rng, part):
    """By the motion's own covariance, to five standard deviations; the other part stays as it is."""
    found = fault_tests.find(measured(equations, rng, (5.0, -4.0), part), 3.5)
    assert fault_tests.moved_parts(found) == [part] and found[part].sigma > 10
    off = found[part].motion[:2] - [5.0, -4.0]
    assert (np.abs(off) < 5 * np.sqrt(np.diag(found[part].covariance))[:2]).all()


def test_two_that_moved_are_both_named(equations, rng):
    once = measured(equations, rng, (6.0, -6.0), "first")
    both = Equations(once.residuals + equations.faults["second"].slopes @ [6.0, 6.0], once.spread, once.faults)
    assert set(fault_tests.moved_parts(fault_tests.find(both, 3.5))) == {"first", "second"}


def test_parts_that_explain_the_same_are_rivals(equations, rng):
    """A part with the same slopes can't be told from the first."""
    moved = measured(equations, rng, (5.0, 5.0))
    twins = Equations(moved.residuals, moved.spread, {**moved.faults, "twin": moved.faults["first"]})
    assert set(fault_tests.moved_parts(fault_tests.find(twins, 3.5))) == {"first", "twin"}


def test_a_part_that_explains_nothing_is_neither_named_nor_a_rival(equations, rng):
    """The first moves far less than is usual for it, so that its evidence is below that of a second that hardly can move."""
    faults = {
        "first": Fault(equations.faults["first"].slopes, np.full(6, 1e5)),
        "second": Fault(equations.faults["second"].slopes, np.full(2, 0.01)),
    }
    found = fault_tests.find(measured(Equations(equations.residuals, equations.spread, faults), rng, (1.5,)), 3.5)
    assert fault_tests.moved_parts(found) == ["first"] and found["second"].sigma < 3


def test_a_part_that_nothing_shows_is_left_out(equations, rng):
    unseen = {**equations.faults, "unseen": Fault(np.zeros((40, 6)), np.ones(6))}
    assert "unseen" not in fault_tests.find(Equations(rng.standard_normal(40), equations.spread, unseen), 3.5)


def test_an_error_within_the_calibration_is_no_alarm(equations, rng):
    """Along a direction that is uncertain by 30 the part seems to have moved by 30, with no sigma in it."""
    faults = {"first": Fault(equations.spread / 30, np.full(3, 100.0))}
    residuals = rng.standard_normal(40) + equations.spread @ [1.0, -1.0, 0.5]
    assert fault_tests.find(Equations(residuals, equations.spread, faults), 3.5)["first"].sigma < 3


def test_larger_noise_is_measured(equations, rng):
    """Three times the predicted, whatever moved and erred, to 5 standard deviations of 29 degrees of freedom, and none at all."""
    moved = measured(equations, rng, (1e3, -1e3))
    noisy = Equations(moved.residuals + np.sqrt(8) * rng.standard_normal(40), moved.spread, moved.faults)
    assert fault_tests.noise_factor(noisy) == pytest.approx(3, rel=5 / np.sqrt(2 * 29))
    quiet = Equations(1e-6 * noisy.residuals, moved.spread, moved.faults)
    assert fault_tests.noise_factor(quiet) == pytest.approx(np.sqrt(200 / 229), rel=1e-3)


@pytest.mark.parametrize("count", [40, 400, 4000])
def test_smaller_noise_counts_as_far_as_equations_show_it(rng, count):
    """A quarter of the predicted, which is worth 200 equations more: to 5 standard deviations."""
    spread, slopes = rng.standard_normal((count, 2)), rng.standard_normal((count, 2))
    quiet = Equations(0.25 * rng.standard_normal(count) + spread @ [3.0, -2.0], spread, {"first": Fault(slopes, np.ones(2))})
    expected = np.sqrt((0.25**2 * (count - 4) + 200) / (count - 4 + 200))
    assert fault_tests.noise_factor(quiet) == pytest.approx(expected, rel=5 / np.sqrt(2 * (count - 4)))


def test_the_best_chance_is_that_of_a_test_along_the_motion(equations, rng):
    """A motion of 3 sigma, tested along itself, is found as often as said, to 5 standard deviations; by any motion less often."""
    effect = equations.faults["first"].slopes[:, 0]
    weight = np.linalg.solve(np.eye(40) + equations.spread @ equations.spread.T, effect)
    step = 3.0 / np.sqrt(effect @ weight)
    draws = [measured(equations, rng, (step,)) for _ in range(500)]
    found = np.mean([abs(one.residuals @ weight) > 2.5 * np.sqrt(effect @ weight) for one in draws])
    chance = fault_tests.best_chance(equations, "first", np.array([step, 0, 0, 0, 0, 0]), 2.5)
    assert chance == pytest.approx(0.691, abs=0.001)  # of a normal number beyond -0.5
    assert found == pytest.approx(chance, abs=5 * np.sqrt(0.25 / 500))
    assert np.mean([fault_tests.find(one, 2.5)["first"].sigma > 2.5 for one in draws]) < chance - 0.1


@pytest.mark.parametrize(("statistic", "freedom", "sigma"), [(9.0, 1, 3.0), (22.4577, 6, 3.2905), (1e4, 1, 100.0)])
def test_statistics_in_standard_deviations(statistic, freedom, sigma):
    """Of one degree of freedom the root; of six, 22.4577 has a chance of 0.001 (tables of chi-square)."""
    assert fault_tests.as_sigma(statistic, freedom) == pytest.approx(sigma, rel=1e-3)
