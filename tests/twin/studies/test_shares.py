"""Shares by level with intervals that count patients, not their cores; parts of a square by leaving them out."""

import numpy as np
import pytest
from scipy.stats import binomtest

from recon.errors import InputError, validated
from tests.twin.studies.made_up import done
from twin.studies import shares, shares_page
from twin.studies.shares import Shares

WANTED = Shares(of="cores", counts={"near": "near"}, square="square_mm2", without={"without_a": "a", "without_b": "b"})


def test_a_core_a_patient_has_wilsons_interval():
    """With one unit less, as the scatter is estimated: within 1 % of scipy's."""
    hits = np.repeat([1.0, 0.0], [60, 140])
    found, known = shares.share(hits, np.ones(200)), binomtest(60, 200).proportion_ci(0.95, "wilson")
    assert found.value == 0.3 and (found.low, found.high) == pytest.approx((known.low, known.high), abs=0.01)
    assert shares.wilson(0.3, 200) == pytest.approx((known.low, known.high), abs=1e-12)


def test_four_cores_that_are_alike_are_worth_one():
    hits = np.repeat([1.0, 0.0], [60, 140])
    assert shares.share(4 * hits, np.full(200, 4.0)) == pytest.approx(shares.share(hits, np.ones(200)))


def test_all_or_none_leaves_an_interval_by_patients():
    """Of 20 patients with 4 cores each, all near: as 20 of 20."""
    known = binomtest(20, 20).proportion_ci(0.95, "wilson")
    assert shares.share(np.full(20, 4.0), np.full(20, 4.0))[:3] == pytest.approx((1.0, known.low, known.high))
    assert np.isnan(shares.share(np.zeros(0), np.zeros(0)).value)


def test_intervals_hold_the_share_of_patients_who_differ(rng):
    """95 % of 1000 trials of 42 patients whose own shares differ (beta 1, 2); 99.9 % of binomial scatter is 2.3 %."""
    held = 0
    for _ in range(1000):
        hits = rng.binomial(4, rng.beta(1, 2, 42)).astype(float)
        found = shares.share(hits, np.full(42, 4.0))
        held += found.low <= 1 / 3 <= found.high
    assert abs(held / 1000 - 0.95) < 0.023


def of(rng, level, count):
    """Patients whose error has two parts of 1 and 2 mm along an axis."""
    for seed in range(count):
        a, b = rng.standard_normal(4), 2 * rng.standard_normal(4)
        figures = {"cores": 4, "near": int((np.abs(a + b) < 1).sum()), "square_mm2": float(((a + b) ** 2).mean())}
        yield done({"rig": level}, figures | {"without_a": float((b**2).mean()), "without_b": float((a**2).mean())}, seed)


def test_parts_that_are_independent_add_up_in_squares(rng):
    """4 and 1 mm2, to 4 of their own standard deviations."""
    found = shares.parts(WANTED, list(of(rng, "worn", 2000)))
    assert [part.source for part in found.parts] == ["b", "a"]
    for part, square in zip(found.parts, (4.0, 1.0), strict=True):
        assert abs(part.alone**2 - square) < 4 * part.larger < 0.8
    assert found.added == pytest.approx(found.whole, rel=0.05)


def test_levels_are_counted_apart_and_failed_trials_not_at_all(rng, tmp_path):
    lost = done({"rig": "worn"}, "target: lost", 99)
    trials = [*of(rng, "worn", 30), lost, *of(rng, "identified", 20)]
    levels = list(shares.by_level(WANTED, trials))
    assert [(field, level, found["near"].trials) for field, level, found in levels] == [
        ("", "", 50), ("rig", "worn", 30), ("rig", "identified", 20)
    ]  # fmt: skip
    (first, second) = shares_page.sections(tmp_path, WANTED, trials)
    assert (tmp_path / "figures/shares.png").stat().st_size > 5000 and "rig: identified" in "".join(first.blocks)
    assert "without it" in "".join(second.blocks) and (tmp_path / "figures/parts.png").exists()
    (none,) = shares_page.sections(tmp_path, WANTED, [lost])
    assert "No trial" in "".join(none.blocks)


def test_unknown_keys_are_refused():
    with pytest.raises(InputError, match="shares: wrong"):
        validated(Shares, WANTED.model_dump() | {"wrong": 1}, "shares")
