"""An error budget: each source of errors alone, a step larger, and all together; beside them what the software predicts.

Sources are fields whose values are sizes of errors, so a source that is off is zero. Contributions are root mean squares over
seeds, and independent ones add up in squares.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from recon.model.rig import Part
from twin.studies import factors
from twin.studies.factors import Point
from twin.studies.study_plots import finite
from twin.studies.study_runs import Done

SMALL = 0.05  # share of the whole's square that is worth a word


class Budget(Part):
    """Sources of errors, and the figures that they add up in."""

    sources: Annotated[dict[str, tuple[str, ...]], Field(min_length=1)]  # fields of each source, by a name for people
    figures: Annotated[dict[str, str], Field(min_length=1)]  # figures and what they are of, for people
    predicted: dict[str, dict[str, str]] = Field(default_factory=dict)  # figure: source or sources joined by +: predicted figure
    step: Annotated[float, Field(gt=1, le=10)] = 2.0  # by which each source is varied
    mend: dict[str, str] = Field(default_factory=dict)  # source: what makes it smaller


@dataclass(frozen=True)
class Contribution:
    """A source's share in a figure."""

    source: str
    alone: float  # RMS over seeds, of this source alone
    larger: float  # a step larger
    trials: int


@dataclass(frozen=True)
class Sum:
    """A figure's budget."""

    figure: str
    whole: float  # RMS over seeds, of all sources
    parts: tuple[Contribution, ...]  # the greatest first
    predicted: Mapping[str, tuple[float, float]]  # of sources that the software knows: predicted, and by switching

    @property
    def added(self) -> float:
        """The parts' sum in squares."""
        return float(np.sqrt(sum(part.alone**2 for part in self.parts)))


def points(budget: Budget, settings: Mapping[str, Any]) -> dict[tuple[str, float], Point]:
    """Values of all sources' fields, by the source that is on and its size over the usual one; ("", 1) is all of them.

    settings : as JSON has them
    """
    usual = {field: factors.value_at(settings, field) for fields in budget.sources.values() for field in fields}
    found = {("", 1.0): dict(usual)}
    for source, fields in budget.sources.items():
        for size in (1.0, budget.step):
            found[source, size] = {field: size * value if field in fields else 0.0 for field, value in usual.items()}
    return found


def added_up(budget: Budget, done: Mapping[tuple[str, float], Sequence[Done]]) -> list[Sum]:
    """The budgets of all figures, from trials by source and size."""
    sums = []
    for figure in budget.figures:
        level = {key: _rms(one.figures.get(figure) for one in trials) for key, trials in done.items()}
        parts = [
            Contribution(source, level[source, 1.0], level[source, budget.step], len(done[source, 1.0]))
            for source in budget.sources
        ]
        predicted = {
            names: (
                _rms(one.figures.get(known) for one in done["", 1.0]),
                float(np.sqrt(sum(level[name.strip(), 1.0] ** 2 for name in names.split(factors.JOINT)))),
            )
            for names, known in budget.predicted.get(figure, {}).items()
        }
        parts.sort(key=lambda part: -part.alone)
        sums.append(Sum(figure, level["", 1.0], tuple(parts), predicted))
    return sums


def advice(budget: Budget, one: Sum) -> list[str]:
    """What to mend first, in words."""
    left, lines = one.added**2, []
    for part in one.parts:
        share = part.alone**2 / one.added**2 if one.added else 0.0
        if share < SMALL:
            break
        without = np.sqrt(max(left - part.alone**2, 0.0))
        remedy = f": {budget.mend[part.source]}" if part.source in budget.mend else ""
        less = f"without it {np.sqrt(left):.3f} mm become {without:.3f} mm"
        lines.append(f"{part.source} makes {100 * share:.0f} % of the square; {less}{remedy}.")
        left -= part.alone**2
    return lines


def explained(one: Sum) -> str:
    """Whether the parts explain the whole, in words."""
    off = one.added / one.whole - 1 if one.whole else np.nan
    return f"{one.whole:.3f} mm by all sources together; {one.added:.3f} mm by their sum in squares, {100 * off:+.0f} %."


def _rms(values: Iterable[Any]) -> float:
    known = finite(values)
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")
