"""A search finds the best of a grid in a fraction of its runs, within bounds, and the same for the same seed."""

import itertools
import math

import numpy as np
import pytest

from recon.errors import InputError
from tests.twin.studies.made_up import done
from twin.studies import factors, rig_search
from twin.studies.rig_search import Bound, Goal

OVER = factors.read(
    {
        "pitch": [6, 9, 12, 18, 27, 40],
        "steps": [3, 4, 6, 8, 12, 18],
        "distance": [60, 90, 120, 165, 220, 300],
        "exposure": [0.002, 0.004, 0.008, 0.012, 0.016],
    }
)
START = {"pitch": 40, "steps": 3, "distance": 60, "exposure": 0.002}
GOAL = Goal(least="error", by="tpe", start=START, bounds={"time": Bound(most=0.08), "overlap": Bound(least=0.5)})


def figures(point) -> dict[str, float]:
    """A rig's error, made up: fringes too fine lose contrast, light and steps take noise out, a far projector sees less."""
    noise = point["pitch"] / np.sqrt(point["steps"] * point["exposure"]) / np.exp(-30 / point["pitch"] ** 2) / point["distance"]
    return {
        "error": float(np.hypot(noise, 0.2)),
        "time": point["steps"] * point["exposure"],
        "overlap": 1.2 - point["distance"] / 350,
    }


def attempt(points):
    return [[done(point, figures(point))] for point in points]


def grid() -> list[dict[str, float]]:
    """Figures of all that keep the bounds, the best first."""
    found = [figures(point) for point in factors.factorial(OVER)]
    return sorted((one for one in found if one["time"] <= 0.08 and one["overlap"] >= 0.5), key=lambda one: one["error"])


@pytest.mark.parametrize("seed", range(3))
def test_the_grids_best_is_found_in_a_quarter_of_its_runs(seed):
    """To 5 %, where 1 % of those within bounds are; from a start five times as bad; all candidates' bounds are as they are."""
    runs = len(factors.factorial(OVER)) // 8
    tried = list(rig_search.search(GOAL.model_copy(update={"runs": runs}), OVER, seed, attempt))
    least = grid()[0]["error"]
    assert len(tried) == runs and tried[0].point == START and tried[0].value > 5 * least
    assert all(one.good == (one.bound["time"] <= 0.08 and one.bound["overlap"] >= 0.5) for one in tried)
    assert sum(not one.good for one in tried) > 0
    found = rig_search.best(tried)
    assert found.good and found.value <= 1.05 * least
    assert found.bound == pytest.approx({name: figures(found.point)[name] for name in ("time", "overlap")})


@pytest.mark.slow
def test_a_gaussian_process_finds_the_best_of_two_factors():
    """Of 30, in ten runs, eight of them drawn before it begins."""
    pytest.importorskip("torch")
    goal = Goal(least="error", runs=10, by="gp", batch=2, start={"pitch": 40, "distance": 60})
    two = {name: OVER[name] for name in goal.start}
    rest = {"steps": 4, "exposure": 0.004}
    tried = list(rig_search.search(goal, two, 0, lambda points: attempt([point | rest for point in points])))
    least = min(figures(point | rest)["error"] for point in factors.factorial(two))
    assert rig_search.best(tried).value <= 1.05 * least


def test_a_search_is_that_of_its_seed_and_of_no_other():
    """And the same whatever the batch's trials took: nothing but their figures counts."""
    goal = GOAL.model_copy(update={"runs": 24, "start": {}})
    first, again, other = ([one.point for one in rig_search.search(goal, OVER, seed, attempt)] for seed in (4, 4, 5))
    assert first == again and first != other


def test_candidates_come_in_batches():
    """The last one has the rest."""
    sizes = []

    def counted(points):
        sizes.append(len(points))
        return attempt(points)

    assert len(list(rig_search.search(GOAL.model_copy(update={"runs": 10}), OVER, 0, counted))) == 10
    assert sizes == [4, 4, 2]


def test_ranges_are_searched_between_their_ends():
    """The least of (log x)^2 + (y - 2)^2 over ranges, to a twentieth of their width; words are tried too."""
    over = factors.read({"x": {"from": 0.01, "to": 100, "log": True}, "y": {"from": 0.0, "to": 10.0}, "how": ["bad", "good"]})

    def bowl(points):
        return [
            [done(at, {"z": np.log10(at["x"]) ** 2 + (at["y"] - 2) ** 2 + 5 * (at["how"] == "bad")})] for at in points
        ]  # fmt: skip

    tried = list(rig_search.search(Goal(least="z", by="tpe", runs=80), over, 1, bowl))
    assert all(0.01 <= one.point["x"] <= 100 and 0 <= one.point["y"] <= 10 for one in tried)
    assert {one.point["how"] for one in tried} == {"bad", "good"}
    found = rig_search.best(tried).point
    assert found["how"] == "good" and abs(np.log10(found["x"])) < 0.2 and abs(found["y"] - 2) < 0.5


def test_candidates_without_figures_are_no_best():
    """Half of the settings measure nothing; the search goes on, and its best is one that does."""

    def lame(points):
        return [[done(at, "coverage: found none" if at["pitch"] < 12 else figures(at))] for at in points]

    tried = list(rig_search.search(GOAL.model_copy(update={"runs": 32, "bounds": {}}), OVER, 0, lame))
    failed = [one for one in tried if one.point["pitch"] < 12]
    assert failed and all(math.isnan(one.value) and not one.good for one in failed)
    assert rig_search.best(tried).point["pitch"] >= 12
    assert rig_search.best(failed) is None and rig_search.best([]) is None


def test_a_candidate_counts_by_its_worst_conditions_and_the_mean_of_its_seeds():
    """The greatest mean where little is better, the least where a figure is bound from below."""
    goal = Goal(least="error", by="tpe", each={"depth": [600, 700]}, bounds={"seen": Bound(least=0.8)})
    trials = [
        done({"pitch": 6, "depth": depth}, {"error": error, "seen": seen}, seed)
        for depth, seed, error, seen in ((600, 0, 1, 0.9), (600, 1, 3, 0.9), (700, 0, 5, 0.7), (700, 1, 1, 0.8))
    ]
    found = rig_search.judged(goal, OVER, {"pitch": 6}, trials)
    assert found.value == 3 and found.bound == {"seen": 0.75}
    assert found.excess == pytest.approx(0.05 / 0.8) and not found.good
    assert rig_search.conditions(goal) == [{"depth": 600}, {"depth": 700}] and rig_search.conditions(Goal(least="x")) == [{}]


@pytest.mark.parametrize(
    "second",
    ["saturated", {"error": math.nan, "seen": 0.9}, {"error": 1.0, "seen": math.nan}, {"error": 1.0, "seen": -math.inf}],
    ids=["failed", "no figure", "no bound figure", "infinite"],
)
def test_one_trial_without_a_figure_spoils_a_candidate(second):
    """Whether it is the one to be least or a bound one, and however the bound lies."""
    trials = [done({"pitch": 6}, {"error": 1.0, "seen": 0.9}, 0), done({"pitch": 6}, second, 1)]
    for bound in (Bound(least=0.8), Bound(most=1.0), Bound(least=0.8, most=1.0)):
        found = rig_search.judged(Goal(least="error", bounds={"seen": bound}), OVER, {"pitch": 6}, trials)
        assert not found.good and rig_search.best([found]) is None
        known = isinstance(second, dict) and math.isfinite(second["seen"])
        assert (found.excess <= 0) == known and (known or found.excess == math.inf)


def test_no_figure_under_one_of_the_conditions_is_the_worst():
    """In either order; of bounds the figure farthest out is shown, which a mean over conditions would hide."""
    goal = Goal(least="error", each={"depth": [600, 700]}, bounds={"seen": Bound(least=0.8, most=1.0)})
    for near, far in ((math.nan, 0.9), (0.9, math.nan)):
        trials = [done({"depth": depth}, {"error": 1.0, "seen": seen}) for depth, seen in ((600, near), (700, far))]
        found = rig_search.judged(goal, OVER, {}, trials)
        assert found.excess == math.inf and math.isnan(found.bound["seen"])
        trials = [done({"depth": depth}, {"error": error, "seen": 0.9}) for depth, error in ((600, near), (700, far))]
        assert math.isnan(rig_search.judged(goal, OVER, {}, trials).value)
    trials = [done({"depth": depth}, {"error": 1.0, "seen": seen}) for depth, seen in ((600, 0.7), (700, 1.4))]
    found = rig_search.judged(goal, OVER, {}, trials)
    assert found.bound == {"seen": 1.4} and found.excess == pytest.approx(0.4)


@pytest.mark.parametrize(
    "goal",
    [
        Goal(least="eror"),
        Goal(least="error", bounds={"sen": Bound(most=1)}),
        Goal(least="error", bounds={"price": Bound(most=1)}),
    ],
    ids=["least", "bound", "price"],
)
def test_figures_that_no_trial_has_are_refused_by_name(goal):
    """Not taken for figures that are missing, with which a search would go on in vain."""
    name = next(iter(goal.bounds), goal.least)
    with pytest.raises(InputError, match=f"search: expected figures among error, seen, found {name}"):
        rig_search.judged(goal, OVER, {"pitch": 6}, [done({"pitch": 6}, {"error": 1.0, "seen": 0.9})])
    assert not rig_search.judged(goal, OVER, {"pitch": 6}, [done({"pitch": 6}, "saturated")]).good


def test_a_search_goes_on_where_a_bound_figure_is_missing():
    """Rigs that see nothing have no overlap; the best is another."""
    goal = GOAL.model_copy(update={"runs": 32})

    def blind(points):
        return [[done(at, figures(at) | ({"overlap": math.nan} if at["distance"] > 100 else {}))] for at in points]

    tried = list(rig_search.search(goal, OVER, 0, blind))
    assert len(tried) == 32 and any(one.excess == math.inf for one in tried)
    assert rig_search.best(tried).point["distance"] <= 100


def test_a_bound_that_is_met_just_so_is_kept():
    assert Bound(most=0.05).excess(0.05) == 0 and Bound(least=0.9).excess(0.9) == 0
    assert Bound(most=0.05).excess(0.06) == pytest.approx(0.2) and Bound(least=0.9).excess(0.81) == pytest.approx(0.1)
    assert Bound(least=1, most=2).excess(1.5) < 0 < Bound(least=1, most=2).excess(0.5)
    assert Bound(most=0).excess(0.5) == 0.5 and Bound().excess(7) == -math.inf
    assert all(Bound(most=1).excess(value) == math.inf for value in (math.nan, math.inf, -math.inf))


def test_prices_are_those_of_the_values():
    """In the order of the list, whatever that is; a bound of the price keeps dear rigs out."""
    over = factors.read({"flux": [1.2, 0.3], "lens": ["plain", "fast", "faster"]})
    prices = {"flux": [1400, 300], "lens": [0, 50, 100]}
    goal = Goal(
        least="error", by="tpe", runs=30, start={"flux": 1.2, "lens": "fast"}, prices=prices, bounds={"price": Bound(most=400)}
    )
    tried = list(rig_search.search(goal, over, 0, lambda points: [[done(at, {"error": 1 / at["flux"]})] for at in points]))
    assert tried[0].point == goal.start
    own = {1.2: 1400, 0.3: 300, "plain": 0, "fast": 50, "faster": 100}
    assert all(one.bound["price"] == sum(own[value] for value in one.point.values()) for one in tried)
    assert {tuple(one.point.values()) for one in tried if one.good} <= set(itertools.product([0.3], ["plain", "fast", "faster"]))
    assert rig_search.best(tried).point["flux"] == 0.3 and any(one.point["flux"] == 1.2 for one in tried)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"start": {"pitch": 40}}, "search: start: expected a value for each of pitch, steps, distance, exposure, found pitch"),
        ({"start": START | {"colour": 1}}, "search: start: expected a value for each of"),
        ({"start": START | {"pitch": 41}}, "search: start.pitch: expected one of"),
        ({"prices": {"pitch": [1, 2]}}, "search: prices.pitch: expected one for each of the 6 values in over, found 2"),
        ({"bounds": {"price": Bound(most=1)}}, "search: price: expected prices with it, found none"),
        ({"prices": {"flux": [1, 2]}}, "search: prices.flux: expected one for each of the 0 values in over, found 2"),
    ],
)
def test_searches_that_can_not_be_made_are_refused(changes, complaint):
    with pytest.raises(InputError) as refused:
        rig_search.check(GOAL.model_copy(update=changes), OVER)
    assert str(refused.value).startswith(complaint)


@pytest.mark.parametrize("value", [0.001, 200.0])
def test_a_start_lies_within_its_range(value):
    over = factors.read({"x": {"from": 0.01, "to": 100, "log": True}})
    with pytest.raises(InputError, match=f"search: start.x: expected 0.01 to 100, found {value}"):
        rig_search.check(Goal(least="z", by="tpe", start={"x": value}), over)
    for end in (0.01, 100):
        rig_search.check(Goal(least="z", by="tpe", start={"x": end}), over)


def test_distributions_are_not_searched_in():
    with pytest.raises(InputError, match="over: flux: expected values or a range to search in, found a distribution"):
        rig_search.check(Goal(least="error", by="tpe"), factors.read({"flux": {"normal": [1, 0.1]}}))


def test_a_gaussian_process_without_torch_is_refused(monkeypatch):
    monkeypatch.setattr(rig_search, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="search: by: gp needs PyTorch"):
        rig_search.check(GOAL.model_copy(update={"by": "gp"}), OVER)
    rig_search.check(GOAL, OVER)


def test_predictions_lead_to_the_best_in_a_fraction_of_the_trials():
    """Of formulas that are off by up to a twentieth, and know nothing of the overlap: it ends once none left can be better."""
    rng = np.random.default_rng(5)
    off = {str(point): 1.1 * (1 + 0.05 * rng.uniform(-1, 1)) for point in factors.factorial(OVER)}

    def foresee(points):
        return [[done(at, {"error": off[str(at)] * (f := figures(at))["error"], "time": f["time"]})] for at in points]

    goal = GOAL.model_copy(update={"runs": 100, "by": "prediction"})
    tried = list(rig_search.search_by_prediction(goal, OVER, foresee, attempt))
    assert len(tried) < len(factors.factorial(OVER)) / 10 and tried[0].point == START
    assert rig_search.best(tried).value == pytest.approx(grid()[0]["error"], rel=0.01)
    rest = [one for one in foresee(factors.factorial(OVER)) if one[0].trial.point not in [each.point for each in tried]]
    able = [figures(one[0].trial.point) for one in rest if one[0].figures["time"] <= 0.08]
    assert min(one["error"] for one in able if one["overlap"] >= 0.5) >= rig_search.best(tried).value * 0.99


def test_predictions_that_are_all_out_of_bounds_leave_the_start():
    goal = GOAL.model_copy(update={"bounds": {"time": Bound(most=1e-6)}, "by": "prediction"})
    foresee = attempt
    assert [one.point for one in rig_search.search_by_prediction(goal, OVER, foresee, attempt)] == [START]
    with pytest.raises(InputError, match="bounds: expected some that a candidate is predicted to keep"):
        list(rig_search.search_by_prediction(goal.model_copy(update={"start": {}}), OVER, foresee, attempt))
