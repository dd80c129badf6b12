"""A study's figures beside those that the paper reports: its method in the twin, ours, and the limit of noise or a prediction."""

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.files.metrics import shown
from recon.model.rig import Part
from twin.studies.study_plots import Name, short
from twin.studies.study_runs import Done, finite

FACTOR = 1.5  # between a figure of the paper and that of its method in the twin, that counts as met
HEAD = (
    *("conditions", "figure", "paper reported", "paper's method in the twin", "met", "ours"),
    *("limit of noise", "predicted for ours", "unit"),
)


class Figure(Part):
    """A figure of the paper's experiments."""

    what: str
    reported: tuple[float, float] | None = None  # least and greatest; None where the paper has none
    paper: str | None = None  # figure of trials by the paper's method
    ours: str
    limit: str | None = None  # figure of what noise alone leaves
    predicted: str | None = None  # figure that our software's covariances predict of ours, which ours may come out below
    meaning: str = ""  # in a sentence, for people
    fitted: bool = False  # the twin was fitted to what the paper reports, so that meeting it says nothing
    bar: float | None = None  # of ours, in the worst trial under conditions that aren't ideal
    at_least: bool = False  # ours may be more than the bar, not less
    factor: Annotated[float, Field(ge=1)] = FACTOR  # between the paper's figure and that of its method, that counts as met
    unit: str


class Compared(NamedTuple):
    """A figure under one of the study's points."""

    point: str
    figure: Figure
    paper: NDArray[np.float64]  # (n,) sizes by the paper's method
    ours: NDArray[np.float64]  # (m,)
    missing: int  # trials without a figure of ours
    limit: float  # of noise; NaN where there is none
    predicted: float  # for ours; NaN likewise

    @property
    def paper_met(self) -> bool | None:
        """Whether the paper's method gives what the paper reports, within a factor; None where nothing is to be met."""
        if self.figure.reported is None or self.figure.fitted:
            return None
        low, high = self.figure.reported
        factor = self.figure.factor
        return bool(self.paper.size and low / factor <= self.paper.mean() <= high * factor)

    @property
    def bar_met(self) -> bool:
        """Whether ours keeps its bar in all trials; nothing is asked where there is none."""
        if self.figure.bar is None:
            return True
        return self.worst >= self.figure.bar if self.figure.at_least else self.worst <= self.figure.bar

    @property
    def worst(self) -> float:
        """Ours in the worst trial; NaN if one has no figure."""
        if self.missing or not self.ours.size:
            return float("nan")
        return float(self.ours.min() if self.figure.at_least else self.ours.max())


def compare(figures: Sequence[Figure], done: Sequence[Done]) -> list[Compared]:
    """Each figure under each point of the study; signs of errors don't count."""
    points: dict[str, list[Done]] = {}
    for one in done:
        points.setdefault(", ".join(short(value) for value in one.trial.point.values()), []).append(one)
    return [_compared(point, figure, alike) for figure in figures for point, alike in points.items()]


def _compared(point: str, figure: Figure, alike: Sequence[Done]) -> Compared:
    paper, ours, limit, predicted = (_sizes(alike, name) for name in (figure.paper, figure.ours, figure.limit, figure.predicted))
    return Compared(point, figure, paper, ours, len(alike) - ours.size, _middle(limit), _middle(predicted))


def cells(one: Compared) -> list[str]:
    """A row of the table: means, and in brackets the least and the greatest."""
    limit = shown(one.limit, ".3g") if one.figure.limit else ""
    predicted = shown(one.predicted, ".3g") if one.figure.predicted else ""
    met = "fitted" if one.figure.fitted else {None: "", True: "yes", False: "no"}[one.paper_met]
    return [
        *(one.point, one.figure.what, _reported(one.figure), _spread(one.paper)),
        *(met, _spread(one.ours), limit, predicted, one.figure.unit),
    ]


def names(figures: Sequence[Figure]) -> dict[str, Name]:
    """Figures of trials by what the study calls them, with what the paper reports."""
    found = {}
    for one in figures:
        unit = f", {one.unit}" if one.unit else ""
        for name, by in ((one.ours, "ours"), (one.paper, "paper's method")):
            if name is not None:
                found[name] = Name(f"{one.what}, {by}{unit}", one.reported)
    return found


def meanings(figures: Sequence[Figure]) -> list[str]:
    """Sentences of what figures mean, each once."""
    return list(dict.fromkeys(figure.meaning for figure in figures if figure.meaning))


def markdown(compared: Sequence[Compared]) -> str:
    """The table as Markdown, without the columns of limit and prediction where no figure has one.

    Of more than two points the means alone, a row a figure and method and a column a point.
    """
    points = list(dict.fromkeys(one.point for one in compared))
    if len(points) > 2:
        return _means(compared, points)
    without = set() if any(one.figure.limit for one in compared) else {"limit of noise"}
    without |= set() if any(one.figure.predicted for one in compared) else {"predicted for ours"}
    rows = [HEAD, *(cells(one) for one in compared)]
    head, *lines = [[cell for name, cell in zip(HEAD, row, strict=True) if name not in without] for row in rows]
    return "\n".join([f"| {' | '.join(head)} |", f"|{'---|' * len(head)}", *(f"| {' | '.join(line)} |" for line in lines)])


def _means(compared: Sequence[Compared], points: Sequence[str]) -> str:
    lines = [["figure", "by", "paper reported", *points, "unit"]]
    lines.append(["---"] * len(lines[0]))
    for figure in dict.fromkeys(one.figure for one in compared):
        at = {one.point: one for one in compared if one.figure == figure}
        means = {by: [shown(_middle(getattr(at[point], by)), ".3f") for point in points] for by in ("paper", "ours")}
        lines.append([figure.what, "paper's method", _reported(figure), *means["paper"], figure.unit])
        lines.append([figure.what, "ours", "", *means["ours"], figure.unit])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _reported(figure: Figure) -> str:
    if figure.reported is None:
        return "none"
    low, high = figure.reported
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _sizes(done: Sequence[Done], figure: str | None) -> NDArray[np.float64]:
    return np.abs(finite(one.figures.get(figure) for one in done)) if figure else np.zeros(0)


def _middle(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if values.size else float("nan")


def _spread(values: NDArray[np.float64]) -> str:
    if not values.size:
        return ""
    return f"{values.mean():.3f} ({values.min():.3f}–{values.max():.3f}; {values.size})"
