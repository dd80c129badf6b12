"""Budgets against the worked examples of JCGM 101, and closed forms of JCGM 100."""

import numpy as np
import pytest
from scipy import stats

from recon.acceptance import gum_budget
from recon.acceptance.gum_budget import Input


def additive(x):
    return sum(x.values())


def rectangular(*standards):
    return [Input(f"x{k}", 0.0, standard, "B", shape="rectangular") for k, standard in enumerate(standards)]


def test_four_rectangular_inputs_are_those_of_jcgm_101(rng):
    """Clause 9.2.3: propagation gives 3.92, Monte Carlo 3.88; both agree within 5 % of u, 0.1."""
    found = gum_budget.evaluate(additive, rectangular(1, 1, 1, 1), rng, 200_000)
    assert found.standard_mm == pytest.approx(2.0) and found.propagated_mm == pytest.approx(3.92, abs=0.001)
    assert found.drawn_mm == pytest.approx((-3.88, 3.88), abs=0.03) and found.validated


def test_a_dominant_rectangular_input_is_not_normal(rng):
    """Clause 9.2.4: propagation gives 19.9, Monte Carlo 17.0, and this is U."""
    found = gum_budget.evaluate(additive, rectangular(1, 1, 1, 10), rng, 200_000)
    assert found.propagated_mm == pytest.approx(19.9, abs=0.05) and not found.validated
    assert found.expanded_mm == pytest.approx(17.0, abs=0.1)


def test_few_degrees_of_freedom_widen_the_interval(rng):
    """Welch and Satterthwaite: of equal parts with 5 and 10 there are 13.3."""
    inputs = [Input("x0", 1.0, 0.1, "A", freedom=5), Input("x1", 2.0, 0.1, "A", freedom=10)]
    found = gum_budget.evaluate(additive, inputs, rng)
    assert found.value_mm == pytest.approx(3.0) and found.freedom == pytest.approx(40 / 3)
    assert found.k == pytest.approx(stats.t.ppf(0.975, 40 / 3))


def test_sensitivities_are_derivatives_and_shares_add_up(rng):
    """Of L (1 + a (T - 20)) at L = 150, a = 11.5e-6, T = 22."""

    def length(x):
        return x["L"] * (1 + x["a"] * (x["T"] - 20))

    inputs = [Input("L", 150, 0.001, "B"), Input("a", 11.5e-6, 1e-6, "B"), Input("T", 22.0, 0.5, "B")]
    found = gum_budget.evaluate(length, inputs, rng)
    slopes = [1 + 2 * 11.5e-6, 150 * 2, 150 * 11.5e-6]
    assert [row.sensitivity for row in found.rows] == pytest.approx(slopes, rel=1e-6)
    assert sum(row.share for row in found.rows) == pytest.approx(1)
    assert found.standard_mm == pytest.approx(np.linalg.norm([row.contribution_mm for row in found.rows]))


def test_exact_inputs_have_no_uncertainty(rng):
    found = gum_budget.evaluate(additive, [Input("x0", 1.0, 0.0, "B")], rng)
    assert found.expanded_mm == 0 and found.validated
