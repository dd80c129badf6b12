"""Parameters whose probe or wires may have moved: errors as large as predicted, over movements as probable as assumed."""

import numpy as np
import pytest

from recon.probe_calibration import open_movement
from recon.probe_calibration.movement import Equations
from recon.probe_calibration.open_movement import EVEN, GIVES, PROPORTIONS, SIZES, SLIP, STILL

FRAMES, UNKNOWNS, PROBE, WIRES = 12, 11, slice(2, 8), slice(8, 11)
WEIGHTS = np.array([300.0, 300.0, 500.0, 500.0, 500.0, *np.full(6, 5.0)])  # of slopes: a pixel, a rad and a mm over 0.2 mm
DRAWS = 300
ALL = np.ones(FRAMES, bool)


def adjusted_at_solution(slopes, left):
    """Equations at the least squares of residuals left : (n, 3), and the step that led there."""
    flat = slopes.reshape(-1, UNKNOWNS)
    step = -np.linalg.lstsq(flat, left.ravel())[0]
    return Equations(slopes, left + slopes @ step, PROBE, WIRES, np.zeros(UNKNOWNS)), step


def drawn(rng, noise):
    """Residuals of the true parameters of the middle, their slopes, and half the movement of the parameters to the end."""
    slopes = WEIGHTS * rng.standard_normal((FRAMES, 3, UNKNOWNS))
    kind = rng.choice(3, p=[STILL, GIVES, SLIP])
    step = np.zeros(UNKNOWNS)
    if kind == 1:
        step[PROBE] = noise * rng.choice(SIZES) * PROPORTIONS @ rng.standard_normal(6)
    if kind == 2:
        step[WIRES] = noise * rng.choice(SIZES) * rng.standard_normal(3)
    after = np.arange(FRAMES) >= rng.integers(1, FRAMES)
    course = np.linspace(-1, 1, FRAMES) if rng.random() < EVEN else np.where(after, 1.0, -1.0)
    return slopes, noise * rng.standard_normal((FRAMES, 3)) - course[:, None] * (slopes @ step), step


@pytest.mark.parametrize("noise", [0.5, 2.0])
def test_squared_errors_at_both_ends_are_those_predicted(rng, noise):
    """Of the probe and of the scales, over movements drawn as assumed: 8 by definition, known to 0.2 by so many draws."""
    squared, rigid = [], []
    for _ in range(DRAWS):
        slopes, left, growth = drawn(rng, noise)
        equations, back = adjusted_at_solution(slopes, left)
        step, covariance = open_movement.adjusted(equations, ALL, ALL)
        flat, rest = slopes.reshape(-1, UNKNOWNS), np.sum(equations.residuals**2)
        still = np.linalg.inv(flat.T @ flat)[:8, :8] * rest / (3 * FRAMES - UNKNOWNS)
        for end in (-growth, growth):
            error = (end - back - step)[:8]
            squared.append(error @ np.linalg.solve(covariance[:8, :8], error))
            rigid.append((end - back)[:8] @ np.linalg.solve(still, (end - back)[:8]))
    assert np.mean(squared) == pytest.approx(8, abs=5 * np.std(squared) / np.sqrt(2 * DRAWS))
    assert 6.5 < np.mean(squared) < 9.5 and np.mean(rigid) > 20


def test_frames_that_turn_out_to_be_right_count_as_if_they_had_been_used(rng):
    """The last four of twelve, outliers to a rigid bracket: added later or adjusted with the others, the outcome is the same."""
    slopes, left, _ = drawn(rng, 1.0)
    used = np.arange(FRAMES) < 8
    back = -np.linalg.lstsq(slopes[used].reshape(-1, UNKNOWNS), left[used].ravel())[0]
    known = np.zeros(UNKNOWNS)
    step, covariance = open_movement.adjusted(Equations(slopes, left + slopes @ back, PROBE, WIRES, known), used, ALL)
    together, back_together = adjusted_at_solution(slopes, left)
    expected, same = open_movement.adjusted(together, ALL, ALL)
    np.testing.assert_allclose(back + step, back_together + expected, atol=1e-9)
    np.testing.assert_allclose(covariance, same, rtol=1e-6, atol=1e-12)
