"""An error budget: each source of errors alone, a step larger, and all together; beside them what the software predicts.

Sources are fields whose values are sizes of errors, so a source that is off is zero. Contributions are root mean squares over
seeds, and independent ones add up in squares.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import Field, model_validator

from recon.errors import InputError
from recon.model.rig import Part
from twin.evaluation.surface_errors import rms
from twin.studies import factors
from twin.studies.factors import Point
from twin.studies.study_runs import Done, finite

SMALL = 0.05  # share of the whole's square that is worth a word
FEW = 8  # seeds, below which an advice says their number


class Budget(Part):
    """Sources of errors, and the figures that are budgeted."""

    sources: Annotated[dict[str, tuple[str, ...]], Field(min_length=1)]  # fields of each source, by a name for people
    figures: Annotated[dict[str, str], Field(min_length=1)]  # figures in mm and what they are of, for people
    predicted: dict[str, dict[str, str]] = Field(default_factory=dict)  # figure: source or sources joined by +: predicted figure
    step: Annotated[float, Field(gt=1, le=10)] = 2.0  # by which each source is varied
    mend: dict[str, str] = Field(default_factory=dict)  # source: what makes it smaller

    @model_validator(mode="after")
    def _known(self) -> "Budget":
        joined = [name.strip() for each in self.predicted.values() for names in each for name in names.split(factors.JOINT)]
        checks = (
            ("predicted", self.predicted, self.figures),
            ("predicted", joined, self.sources),
            ("mend", self.mend, self.sources),
        )
        for place, names, known in checks:
            for name in names:
                if name not in known:
                    raise ValueError(f"{place}: expected among {', '.join(known)}, found {name}")
        return self


@dataclass(frozen=True)
class Contribution:
    """A source's share in a figure."""

    source: str
    alone: float  # RMS over seeds, of this source alone
    larger: float  # a step larger
    trials: int  # that gave the figure

    @property
    def uncertainty(self) -> float:
        """Standard deviation of `alone`, as of draws from a normal distribution, one a seed."""
        return _uncertainty(self.alone, self.trials)


@dataclass(frozen=True)
class Sum:
    """A figure's budget."""

    figure: str
    whole: float  # RMS over seeds, of all sources
    trials: int
    parts: tuple[Contribution, ...]  # the greatest first
    predicted: Mapping[str, tuple[float, float]]  # of sources that the software knows: predicted, and by switching

    @property
    def uncertainty(self) -> float:
        """Standard deviation of `whole`, as of a contribution."""
        return _uncertainty(self.whole, self.trials)

    @property
    def added(self) -> float:
        """The parts' sum in squares."""
        return float(np.sqrt(sum(part.alone**2 for part in self.parts)))


def points(budget: Budget, settings: Mapping[str, Any]) -> dict[tuple[str, float], Point]:
    """Values of all sources' fields, by the source that is on and its size over the usual one; ("", 1) is all of them.

    settings : as JSON has them
    """
    usual = {field: factors.value_at(settings, field) for fields in budget.sources.values() for field in fields}
    for field, value in usual.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
            raise InputError(f"budget: sources: {field}: expected the size of an error, above zero, found {value}")
    found = {("", 1.0): dict(usual)}
    for source, fields in budget.sources.items():
        for size in (1.0, budget.step):
            found[source, size] = {field: size * value if field in fields else 0.0 for field, value in usual.items()}
    return found


def label(source: str, size: float) -> str:
    """A point of the budget for people, by its key."""
    if not source:
        return "all sources"
    return f"{source} alone" if size == 1 else f"{source} alone, {size:g} times as large"


def added_up(budget: Budget, done: Mapping[tuple[str, float], Sequence[Done]]) -> list[Sum]:
    """The budgets of all figures, from trials by source and size."""
    sums = []
    for figure in budget.figures:
        sizes = {key: finite(one.figures.get(figure) for one in trials) for key, trials in done.items()}
        level = {key: rms(values) for key, values in sizes.items()}
        parts = [
            Contribution(source, level[source, 1.0], level[source, budget.step], len(sizes[source, 1.0]))
            for source in budget.sources
        ]
        predicted = {
            names: (
                rms(finite(one.figures.get(known) for one in done["", 1.0])),
                float(np.sqrt(sum(level[name.strip(), 1.0] ** 2 for name in names.split(factors.JOINT)))),
            )
            for names, known in budget.predicted.get(figure, {}).items()
        }
        parts.sort(key=lambda part: -np.nan_to_num(part.alone))
        sums.append(Sum(figure, level["", 1.0], len(sizes["", 1.0]), tuple(parts), predicted))
    return sums


def advice(budget: Budget, one: Sum) -> list[str]:
    """What to mend first, in words."""
    left, lines = one.added**2, []
    by = f", by {seeds(one.trials)} only" if one.trials < FEW else ""
    for part in one.parts:
        share = part.alone**2 / one.added**2 if one.added else 0.0
        if not share >= SMALL:
            break
        without = np.sqrt(max(left - part.alone**2, 0.0))
        remedy = f": {budget.mend[part.source]}" if part.source in budget.mend else ""
        less = f"without it {np.sqrt(left):.3f} mm become {without:.3f} mm"
        lines.append(f"{part.source} makes {100 * share:.0f} % of the square{by}; {less}{remedy}.")
        left -= part.alone**2
    return lines


def explained(one: Sum) -> str:
    """Whether the parts explain the whole, in words."""
    off = one.added / one.whole - 1 if one.whole else np.nan
    return (
        f"{one.whole:.3f} mm by all sources together, ± {100 * _uncertainty(1.0, one.trials):.0f} % by {seeds(one.trials)}; "
        f"{one.added:.3f} mm by their sum in squares, {100 * off:+.0f} %."
    )


def seeds(count: int) -> str:
    """A number of seeds in words."""
    return f"{count} seed" + ("" if count == 1 else "s")


def _uncertainty(size: float, trials: int) -> float:
    """Standard deviation of a root mean square over so many trials, one draw of a normal distribution each."""
    return size / np.sqrt(2 * max(trials, 1))
