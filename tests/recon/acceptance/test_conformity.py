"""Decisions by ISO 14253-1: what is accepted and what is rejected is proven, between them nothing is."""

import numpy as np
import pytest

from recon.acceptance.conformity import decide, together


@pytest.mark.parametrize(
    ("value", "expanded", "decision"),
    [
        (0.05, 0.02, "accepted"),
        (-0.05, 0.02, "accepted"),
        (0.09, 0.02, "neither"),
        (-0.11, 0.02, "neither"),
        (0.13, 0.02, "rejected"),
        (-0.13, 0.02, "rejected"),
        (0.0, 0.11, "neither"),
    ],
)
def test_the_uncertainty_counts_against_who_proves(value, expanded, decision):
    assert decide(value, expanded, 0.1) == decision


def test_a_bad_rig_is_hardly_ever_accepted_and_a_good_one_hardly_ever_rejected(rng):
    """At the limit itself each happens in 2.5 % of tests, as U is two-sided for 95 %: 400 of 16000, within 5 sigma."""
    found = [decide(value, 1.96, 100.0) for value in 100.0 + rng.standard_normal(16_000)]
    for decision in ("accepted", "rejected"):
        assert abs(found.count(decision) - 400) < 5 * np.sqrt(400)


def test_one_value_rejects_a_rig_and_all_accept_it():
    assert together(["accepted", "accepted"]) == "accepted"
    assert together(["accepted", "neither"]) == "neither"
    assert together(["neither", "rejected", "accepted"]) == "rejected"
    assert together([]) == "neither"
