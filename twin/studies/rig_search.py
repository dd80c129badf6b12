"""Search for the settings that make a figure least, under bounds of other figures and of the price.

By Optuna, or in the order of what formulas predict, which needs a fraction of the trials where an experiment has such formulas.
Candidates come in batches of a fixed size and are told of in order, so a search is the same whatever the engine; one that was
stopped goes on by its kept trials.
"""

import itertools
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Annotated, Any, Literal

import optuna
from pydantic import Field

from recon.errors import InputError
from recon.model.rig import Part
from twin.studies.factors import Choices, Factor, Normal, Point, Range, factorial, filling
from twin.studies.study_runs import Done, numeric

PRICE = "price"
DRAWN = 4096  # points that are drawn from ranges, to be predicted
CLOSE = 0.05  # relative error of a prediction, by which a bound may be missed that a trial would keep


class Bound(Part):
    """What is asked of a figure."""

    least: float | None = None
    most: float | None = None

    def excess(self, value: float) -> float:
        """How far a value is out of bounds, relative to the bound; 0 or less within, infinite if there is none."""
        if not math.isfinite(value):
            return math.inf
        over = [(value - self.most) / (abs(self.most) or 1)] if self.most is not None else []
        under = [(self.least - value) / (abs(self.least) or 1)] if self.least is not None else []
        return max([*over, *under, -math.inf])


class Goal(Part):
    """What is searched for."""

    least: str  # figure to be least: its mean over seeds, in the worst of `each`
    runs: Annotated[int, Field(ge=1, le=100_000)] = 24  # candidates
    batch: Annotated[int, Field(ge=1, le=1000)] = 4  # that are chosen at once, and can be tried at the same time
    by: Literal["gp", "tpe", "prediction"] = "gp"  # Gaussian process, which needs PyTorch; Parzen estimators, which need thrice
    # the runs; or formulas of the experiment, best first, until none that is left is predicted to be better
    start: Point = Field(default_factory=dict)  # the first candidate: the rig as it is; a value for each field of over, or none
    each: dict[str, list[Any]] = Field(default_factory=dict)  # fields and values that a candidate is tried under, such as depths
    bounds: dict[str, Bound] = Field(default_factory=dict)  # of figures, and of `price`
    prices: dict[str, list[float]] = Field(default_factory=dict)  # of each value in a factor's list


@dataclass(frozen=True)
class Candidate:
    """Settings that were tried."""

    point: Point
    done: tuple[Done, ...]
    value: float  # of the figure to be least: its mean over seeds, the greatest of each; NaN if a trial gave none
    bound: Mapping[str, float]  # figures that are bound: means over seeds, where they are farthest out
    excess: float  # by which a bound is missed, relative to it, at most; 0 or less if none is

    @property
    def good(self) -> bool:
        """Whether it has figures and keeps all bounds."""
        return math.isfinite(self.value) and self.excess <= 0

    @property
    def lost(self) -> str:
        """Why there is no figure to be least, in one line; empty where there is one."""
        if math.isfinite(self.value):
            return ""
        return next((one.found for one in self.done if isinstance(one.found, str)), "the figure is missing in a trial")


def missed(goal: Goal, candidate: Candidate) -> str:
    """The figure, or the price, that is farthest out of its bound; empty where all bounds are kept."""
    if candidate.excess <= 0:
        return ""
    return max(candidate.bound, key=lambda name: goal.bounds[name].excess(candidate.bound[name]))


def check(goal: Goal, factors: Mapping[str, Factor]) -> None:
    """Refuse a search that can't be made; raises InputError."""
    for name, factor in factors.items():
        if isinstance(factor, Normal):
            raise InputError(f"over: {name}: expected values or a range to search in, found a distribution")
    if goal.start and set(goal.start) != set(factors):
        raise InputError(f"search: start: expected a value for each of {', '.join(factors)}, found {', '.join(goal.start)}")
    if PRICE in (goal.least, *goal.bounds) and not goal.prices:
        raise InputError("search: price: expected prices with it, found none")
    for name, value in goal.start.items():
        factor = factors[name]
        if isinstance(factor, Choices) and value not in factor.choices:
            raise InputError(f"search: start.{name}: expected one of {factor.choices}, found {value}")
        if isinstance(factor, Range) and not (numeric([value]) and factor.first <= value <= factor.last):
            raise InputError(f"search: start.{name}: expected {factor.first:g} to {factor.last:g}, found {value}")
    if goal.by == "gp" and find_spec("torch") is None:
        raise InputError(
            "search: by: gp needs PyTorch, of sonotwin's extra train, found none; install it, or give search='{by: tpe}'"
        )
    for name, prices in goal.prices.items():
        factor = factors.get(name)
        count = len(factor.choices) if isinstance(factor, Choices) else 0
        if count != len(prices):
            raise InputError(f"search: prices.{name}: expected one for each of the {count} values in over, found {len(prices)}")


def conditions(goal: Goal) -> list[Point]:
    """All combinations of what a candidate is tried under."""
    return [dict(zip(goal.each, values, strict=True)) for values in itertools.product(*goal.each.values())]


def search(
    goal: Goal,
    factors: Mapping[str, Factor],
    seed: int,
    attempt: Callable[[Sequence[Point]], Sequence[Sequence[Done]]],
) -> Iterator[Candidate]:
    """Try candidates, and give them in order.

    Parameters
    ----------
    attempt : does all trials of some points, and gives them point by point
    """
    study = optuna.create_study(sampler=_sampler(goal, seed))
    if goal.start:
        study.enqueue_trial({name: _as_parameter(factors[name], value) for name, value in goal.start.items()})
    for first in range(0, goal.runs, goal.batch):
        asked = [study.ask() for _ in range(min(goal.batch, goal.runs - first))]
        points = [{name: _suggested(trial, name, factor) for name, factor in factors.items()} for trial in asked]
        for trial, point, done in zip(asked, points, attempt(points), strict=True):
            candidate = judged(goal, factors, point, done)
            if math.isfinite(candidate.excess):
                trial.set_constraint("bounds", candidate.excess)
            if math.isfinite(candidate.value):
                study.tell(trial, candidate.value)
            else:
                study.tell(trial, state=optuna.trial.TrialState.FAIL)
            yield candidate


def search_by_prediction(
    goal: Goal,
    factors: Mapping[str, Factor],
    foresee: Callable[[Sequence[Point]], Sequence[Sequence[Done]]],
    attempt: Callable[[Sequence[Point]], Sequence[Sequence[Done]]],
) -> Iterator[Candidate]:
    """Try candidates in the order of what is predicted for them, until none that is left is predicted to be better.

    What is found is compared with what was predicted: none is left when even the least ratio so far doesn't make the next
    candidate better than the best one. Bounds of figures that aren't predicted count once these are found.

    Parameters
    ----------
    foresee : predicts the trials of some points, and gives them point by point
    attempt : does them
    """
    listed = all(isinstance(factor, Choices) for factor in factors.values())
    points = factorial(factors) if listed else filling(factors, DRAWN, "sobol")
    predicted = foresee(points)
    figures = {name for done in predicted for one in done for name in one.figures} | {PRICE}
    known = goal.model_copy(update={"bounds": {name: bound for name, bound in goal.bounds.items() if name in figures}})
    judgements = [judged(known, factors, point, done) for point, done in zip(points, predicted, strict=True)]
    likely = sorted((one for one in judgements if one.excess <= CLOSE and math.isfinite(one.value)), key=lambda one: one.value)
    if not (likely or goal.start):
        raise InputError("search: bounds: expected some that a candidate is predicted to keep, found none that does")
    if goal.start:
        likely = [one for one in likely if one.point != goal.start]
        likely.insert(0, judged(known, factors, goal.start, foresee([goal.start])[0]))
    tried, ratios = list[Candidate](), list[float]()
    for first in range(0, min(len(likely), goal.runs), goal.batch):
        batch = likely[first : min(first + goal.batch, goal.runs)]
        found = best(tried)
        if found is not None and ratios and min(ratios) * min(one.value for one in batch) > found.value:
            return
        for one, done in zip(batch, attempt([one.point for one in batch]), strict=True):
            tried.append(judged(goal, factors, one.point, done))
            if math.isfinite(tried[-1].value / one.value):
                ratios.append(tried[-1].value / one.value)
            yield tried[-1]


def _sampler(goal: Goal, seed: int) -> optuna.samplers.BaseSampler:
    """How the next candidates are chosen."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    with warnings.catch_warnings(action="ignore", category=optuna.exceptions.ExperimentalWarning):
        if goal.by == "gp":
            return optuna.samplers.GPSampler(seed=seed, n_startup_trials=2 * goal.batch)
        return optuna.samplers.TPESampler(seed=seed, multivariate=True, n_startup_trials=3 * goal.batch, n_ei_candidates=100)


def judged(goal: Goal, factors: Mapping[str, Factor], point: Point, done: Sequence[Done]) -> Candidate:
    """A candidate by its trials; one of whose trials has no figure is out of all bounds.

    Raises
    ------
    InputError
        If trials have no figure of a name that the goal or a bound has.
    """
    cost = {PRICE: price(goal, factors, point)} if goal.prices else {}
    for one in done:
        for name in (goal.least, *goal.bounds):
            if one.figures and name not in one.figures | cost:
                raise InputError(f"search: expected figures among {', '.join([*one.figures, *cost])}, found {name}")
    under = [[one for one in done if within(one, some)] for some in conditions(goal)]
    worst, excess = {}, -math.inf
    for name, bound in goal.bounds.items():
        means = [cost[name]] if name in cost else [_mean(trials, name) for trials in under]
        worst[name] = max(means, key=bound.excess)
        excess = max(excess, bound.excess(worst[name]))
    values = [cost.get(goal.least, _mean(trials, goal.least)) for trials in under]
    return Candidate(point, tuple(done), max(values) if all(map(math.isfinite, values)) else math.nan, worst, excess)


def _mean(done: Sequence[Done], figure: str) -> float:
    """Mean over trials; NaN if one of them lacks the figure."""
    return sum(one.figures.get(figure, math.nan) for one in done) / len(done)


def within(done: Done, some: Point) -> bool:
    """Whether a trial was done under some conditions."""
    return all(done.trial.point.get(name) == value for name, value in some.items())


def price(goal: Goal, factors: Mapping[str, Factor], point: Point) -> float:
    """Sum of the prices of a point's values."""
    total = 0.0
    for name, prices in goal.prices.items():
        factor = factors[name]
        assert isinstance(factor, Choices)
        total += prices[factor.choices.index(point[name])]
    return total


def best(candidates: Sequence[Candidate]) -> Candidate | None:
    """The best candidate that keeps all bounds, if one does."""
    return min((one for one in candidates if one.good), key=lambda one: one.value, default=None)


def _suggested(trial: optuna.Trial, name: str, factor: Factor) -> Any:
    """A value that Optuna suggests: numbers of a list by their place, so that neighbours count as alike."""
    if isinstance(factor, Range):
        value = trial.suggest_float(name, factor.first, factor.last, log=factor.log)
        return round(value) if factor.whole else value
    assert isinstance(factor, Choices)
    if numeric(factor.choices):
        return sorted(factor.choices)[trial.suggest_int(name, 0, len(factor.choices) - 1)]
    return factor.choices[trial.suggest_categorical(name, list(range(len(factor.choices))))]


def _as_parameter(factor: Factor, value: Any) -> Any:
    """What Optuna has for a value."""
    if isinstance(factor, Choices):
        return (sorted(factor.choices) if numeric(factor.choices) else factor.choices).index(value)
    return value
