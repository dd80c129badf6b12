"""A budget turns each source on by itself; independent errors add up in squares."""

import numpy as np
import pytest

from recon.errors import InputError
from tests.twin.studies.made_up import done
from twin.studies import error_budget
from twin.studies.error_budget import Budget

SETTINGS = {"noise": {"drawn": {"column": 1.0, "circle": 0.5}}, "conditions": {"board": {"bow_mm": 0.1, "flex_mm": 0.005}}}
BOW = ("conditions.board.bow_mm", "conditions.board.flex_mm")
BUDGET = Budget(
    sources={"fringes": ("noise.drawn.column",), "circles": ("noise.drawn.circle",), "bow": BOW},
    figures={"error_mm": "a place"},
    step=3.0,
    mend={"bow": "a stiffer plate"},
)
SIZES = {"fringes": 0.02, "circles": 0.15, "bow": 0.4}  # mm


def test_a_point_has_one_source_or_all():
    """In units of the usual size; all other sources are zero."""
    points = error_budget.points(BUDGET, SETTINGS)
    column, circle, (bow, flex) = "noise.drawn.column", "noise.drawn.circle", BOW
    off = {column: 0.0, circle: 0.0, bow: 0.0, flex: 0.0}
    assert list(points) == [("", 1.0), *((source, size) for source in BUDGET.sources for size in (1.0, 3.0))]
    assert points["", 1.0] == {column: 1.0, circle: 0.5, bow: 0.1, flex: 0.005}
    assert points["circles", 1.0] == off | {circle: 0.5} and points["circles", 3.0] == off | {circle: 1.5}
    assert points["bow", 3.0] == pytest.approx(off | {bow: 0.3, flex: 0.015})


def test_a_source_that_is_not_there_is_refused_by_name():
    lost = BUDGET.model_copy(update={"sources": {"bow": ("conditions.board.bow_m",)}})
    with pytest.raises(
        InputError, match=r"conditions\.board\.bow_m: unknown key bow_m; expected one of bow_mm, flex_mm; did you mean bow_mm\?"
    ):
        error_budget.points(lost, SETTINGS)


@pytest.mark.parametrize("value", [0.0, -0.1, True, "large", None, float("nan")])
def test_a_source_is_the_size_of_an_error(value):
    """Zero can't be varied, and a word can't be turned off."""
    settings = SETTINGS | {"noise": {"drawn": {"column": value, "circle": 0.5}}}
    with pytest.raises(InputError, match=r"sources: noise\.drawn\.column: expected the size of an error, above zero, found"):
        error_budget.points(BUDGET, settings)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"predicted": {"eror_mm": {"bow": "known_mm"}}}, "predicted: expected among error_mm, found eror_mm"),
        (
            {"predicted": {"error_mm": {"fringes + box": "known_mm"}}},
            "predicted: expected among .*, bow, found box",
        ),
        ({"mend": {"bough": "a stiffer plate"}}, "mend: expected among fringes, circles, bow, found bough"),
    ],
)
def test_names_are_those_of_figures_and_sources(changes, complaint):
    with pytest.raises(ValueError, match=complaint):
        Budget.model_validate(BUDGET.model_dump() | changes)
    Budget.model_validate(BUDGET.model_dump() | {"predicted": {"error_mm": {"fringes + bow": "known_mm"}}})


def drawn(budget: Budget, rng, count: int) -> dict:
    """Trials of independent normal errors, a sum where all sources are on; `sizes` are predicted a tenth too large."""
    trials = {}
    for source, size in error_budget.points(budget, SETTINGS):
        on = {name: SIZES[name] for name in budget.sources if source in ("", name)}
        errors = sum(size * sigma * rng.standard_normal(count) for sigma in on.values())
        trials[source, size] = [
            done({}, {"error_mm": float(error), "known_mm": 1.1 * SIZES["fringes"], "both_mm": 0.2}, seed)
            for seed, error in enumerate(errors)
        ]
    return trials


def test_independent_errors_add_up_in_squares(rng):
    """Of 4000 seeds: each part its size, a step larger that many times; the greatest first; their sum the whole, all to 5 %."""
    (found,) = error_budget.added_up(BUDGET, drawn(BUDGET, rng, 4000))
    assert [part.source for part in found.parts] == ["bow", "circles", "fringes"]
    for part in found.parts:
        assert (part.alone, part.larger, part.trials) == (
            *(pytest.approx(k * SIZES[part.source], rel=0.05) for k in (1, 3)),
            4000,
        )
    assert found.added == pytest.approx(np.sqrt(sum(sigma**2 for sigma in SIZES.values())), rel=0.05)
    assert found.whole == pytest.approx(found.added, rel=0.05) and found.trials == 4000


def test_a_contribution_is_known_as_well_as_its_spread_says(rng):
    """Over 400 budgets of 24 seeds: their standard deviation to 12 %, three of its own."""
    budget = Budget(sources={"bow": BOW}, figures={"error_mm": "a place"})
    parts = [error_budget.added_up(budget, drawn(budget, rng, 24))[0].parts[0] for _ in range(400)]
    spread = np.std([part.alone for part in parts])
    assert np.mean([part.uncertainty for part in parts]) == pytest.approx(spread, rel=0.12)


def test_predictions_stand_beside_what_switching_finds(rng):
    """Of one source, and of two joined by +, which add up in squares."""
    predicted = {"error_mm": {"fringes": "known_mm", "circles + bow": "both_mm"}}
    (found,) = error_budget.added_up(BUDGET.model_copy(update={"predicted": predicted}), drawn(BUDGET, rng, 4000))
    assert found.predicted["fringes"] == pytest.approx((1.1 * SIZES["fringes"], SIZES["fringes"]), rel=0.05)
    assert found.predicted["circles + bow"] == pytest.approx((0.2, np.hypot(0.15, 0.4)), rel=0.05)


def given(alone: dict[str, float], whole: float, trials: int = 8) -> error_budget.Sum:
    """A budget by its parts."""
    parts = tuple(error_budget.Contribution(source, value, 2 * value, trials) for source, value in alone.items())
    return error_budget.Sum("error_mm", whole, trials, parts, {})


def test_advice_begins_with_the_greatest_and_leaves_out_the_small():
    """A source of one per cent gets no line; each line goes on from the one before."""
    lines = error_budget.advice(BUDGET, given({"bow": 0.4, "fringes": 0.3, "circles": 0.05}, 0.5))
    assert len(lines) == 2
    assert lines[0] == "bow makes 63 % of the square; without it 0.502 mm become 0.304 mm: a stiffer plate."
    assert lines[1] == "fringes makes 36 % of the square; without it 0.304 mm become 0.050 mm."


@pytest.mark.parametrize(("trials", "by"), [(1, ", by 1 seed only"), (7, ", by 7 seeds only"), (8, "")])
def test_advice_of_few_seeds_says_their_number(trials, by):
    """And a whole of one seed is uncertain by 71 %, which is no precision."""
    found = given({"bow": 0.4}, 0.4, trials)
    assert error_budget.advice(BUDGET, found)[0].startswith(f"bow makes 100 % of the square{by}; without it")
    if trials == 1:
        assert "0.400 mm by all sources together, ± 71 % by 1 seed; " in error_budget.explained(found)


def test_a_point_has_a_short_name():
    assert [error_budget.label(*key) for key in (("", 1.0), ("bow", 1.0), ("bow", 2.5))] == [
        "all sources",
        "bow alone",
        "bow alone, 2.5 times as large",
    ]


def test_no_error_needs_no_advice():
    """Nor does its sum divide by zero."""
    nothing = given({"bow": 0.0, "fringes": 0.0}, 0.0)
    assert error_budget.advice(BUDGET, nothing) == [] and nothing.added == 0
    assert "0.000 mm by all sources" in error_budget.explained(nothing)


def test_what_the_parts_explain_is_said():
    """And how well the whole is known: 8 seeds, 1 / sqrt(16)."""
    assert error_budget.explained(given({"bow": 0.3, "fringes": 0.4}, 0.4)) == (
        "0.400 mm by all sources together, ± 25 % by 8 seeds; 0.500 mm by their sum in squares, +25 %."
    )


def test_a_trial_without_figures_leaves_the_others():
    """Root mean squares are over those that have some; without any it is unknown."""
    trials = {key: [done({}, {"error_mm": 0.3}, 0), done({}, "lost", 1)] for key in error_budget.points(BUDGET, SETTINGS)}
    trials["bow", 1.0] = [done({}, "lost", 0)]
    (found,) = error_budget.added_up(BUDGET, trials)
    by_name = {part.source: part for part in found.parts}
    assert (found.whole, found.trials) == (pytest.approx(0.3), 1)
    assert (by_name["circles"].alone, by_name["circles"].trials) == (pytest.approx(0.3), 1)
    assert np.isnan(by_name["bow"].alone) and by_name["bow"].trials == 0


@pytest.mark.parametrize("field", ["sources", "figures"])
def test_a_budget_of_nothing_is_refused(field):
    with pytest.raises(ValueError, match=field):
        Budget.model_validate(BUDGET.model_dump() | {field: {}})


@pytest.mark.parametrize("step", [1.0, 0.5, 11.0])
def test_a_step_is_larger_than_the_usual_size(step):
    with pytest.raises(ValueError, match="step"):
        Budget.model_validate(BUDGET.model_dump() | {"step": step})
