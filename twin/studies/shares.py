"""Shares of what trials count, such as cores near enough, by each level of each factor, and what a squared error is made of.

Counts of one trial are of one patient, and alike: the trial is the unit. An interval is Wilson's with as many units as would
scatter as much if they were independent, but never more than there are [Korn & Graubard 1998, Survey Methodology 24(2), who take
Clopper's and Pearson's interval].
"""

from collections.abc import Iterator, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy import stats

from recon.model.rig import Part
from twin.studies.error_budget import Contribution, Sum
from twin.studies.study_runs import Done, cell

Array = NDArray[np.float64]

CONFIDENCE = 0.95


class Shares(Part):
    """What is counted."""

    of: str  # figure: how many a trial has
    counts: Annotated[dict[str, str], Field(min_length=1)]  # figures: how many of these are something, for people
    square: str  # figure: mean square of an error, mm2
    without: dict[str, str]  # figures: the same without one of its parts, and the part, for people


class Share(NamedTuple):
    """A share with its interval, of so many trials."""

    value: float
    low: float
    high: float
    trials: int  # that gave figures
    refused: int = 0  # that gave none


def share(hits: Array, units: Array) -> Share:
    """Share of hits : (n,) among units : (n,), by trials; NaN of none."""
    total, count = float(units.sum()), len(units)
    if not total:
        return Share(np.nan, np.nan, np.nan, 0)
    value = float(hits.sum()) / total
    variance = count / max(count - 1, 1) * float(((hits - value * units) ** 2).sum()) / total**2
    worth = min(value * (1 - value) / variance, total) if variance > 0 else float(count)
    low, high = wilson(value, worth)
    return Share(value, low, high, count)


def wilson(value: float, count: float) -> tuple[float, float]:
    """Wilson's interval [Wilson 1927] of a share of a count, which needn't be whole."""
    z = float(stats.norm.ppf((1 + CONFIDENCE) / 2))
    middle = (value + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * np.sqrt(value * (1 - value) / count + z**2 / (4 * count**2))
    return max(float(middle - half), 0.0), min(float(middle + half), 1.0)


def by_level(wanted: Shares, done: Sequence[Done]) -> Iterator[tuple[str, Any, dict[str, Share]]]:
    """Factor, level and shares of all counts: of all trials first ("", ""), then of each level of each factor that varies."""
    yield "", "", _shares(wanted, done)
    for field in done[0].trial.point if done else ():
        levels = list(dict.fromkeys(cell(one.trial.point[field]) for one in done))
        for level in levels if len(levels) > 1 else ():
            yield field, level, _shares(wanted, [one for one in done if cell(one.trial.point[field]) == level])


def _shares(wanted: Shares, done: Sequence[Done]) -> dict[str, Share]:
    here = [one for one in done if not one.failed]
    units, refused = np.array([one.figures[wanted.of] for one in here], float), len(done) - len(here)
    found = {name: share(np.array([one.figures[name] for one in here], float), units) for name in wanted.counts}
    return {name: one._replace(refused=refused) for name, one in found.items()}


def parts(wanted: Shares, done: Sequence[Done]) -> Sum:
    """What each part adds to the error's square: what is gone without it, which may be less than nothing by chance.

    A part's `larger` is the standard deviation, mm2, of what it adds.
    """
    here = [one.figures for one in done if not one.failed]
    squares = np.array([one[wanted.square] for one in here], float)
    found = []
    for name, words in wanted.without.items():
        added = squares - np.array([one[name] for one in here], float)
        sigma = float(added.std(ddof=1) / np.sqrt(len(added))) if len(added) > 1 else np.nan
        found.append(Contribution(words, float(np.sqrt(max(added.mean(), 0.0))) if len(added) else np.nan, sigma, len(here)))
    whole = float(np.sqrt(squares.mean())) if here else np.nan
    return Sum(wanted.square, whole, len(here), tuple(sorted(found, key=lambda part: -np.nan_to_num(part.alone))), {})
