"""Plots of a study: a figure over a factor, with its spread, and its closed form."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from recon.reports import figures
from recon.reports.figures import LINE
from twin.studies.study_runs import finite, numeric

Array = NDArray[np.float64]
Table = Sequence[Mapping[str, Any]]  # a row a trial

MOST_LINES = 6  # values of another factor that get a line each
MOST_VALUES = 24  # of a factor; more are drawn as points
WIDE = 1.5  # ratio of the largest to the smallest step between values, above which an axis is logarithmic
TALL = 8.0  # ratio of the largest to the smallest figure, likewise


@dataclass(frozen=True)
class Course:
    """A figure over a factor's values : (n,)."""

    label: str
    middle: Array  # median
    low: Array  # least
    high: Array  # greatest


def draw(table: Table, figure: str, field: str, fields: Sequence[str], limit: str, kind: str = "closed form") -> Figure:
    """Draw a figure over a factor.

    Few values of another factor get a line each; a factor with many values, as of a space-filling design, is a cloud of points.

    Parameters
    ----------
    fields : all factors
    limit : what the figure is held against, also a column of the table, or ""
    kind : of the limit, for the legend
    """
    drawn, axes = figures.blank(5.2, 3.3)
    values = distinct(row[field] for row in table)
    if len(values) > MOST_VALUES and numeric(values):
        for name, style in ((figure, "o"), (limit, "x")):
            if name:
                label = kind if name == limit else "a trial"
                x, y = (np.array([row.get(key, np.nan) for row in table], float) for key in (field, name))
                axes.plot(x, y, style, color=LINE if name == limit else "C0", markersize=3, label=label)
    else:
        places = np.array(values, float) if numeric(values) else np.arange(len(values), dtype=float)
        if not numeric(values):
            axes.set_xticks(places, [short(value) for value in values])
        elif unevenly_spaced(places):
            axes.set_xscale("log")
            axes.set_xticks(places, [short(value) for value in values])
            axes.minorticks_off()
        other = other_factor(table, field, fields)
        for k, course in enumerate(courses(table, figure, field, other)):
            axes.fill_between(places, course.low, course.high, color=f"C{k}", alpha=0.18, linewidth=0)
            axes.plot(places, course.middle, "o-", color=f"C{k}", markersize=4, linewidth=1.4, label=course.label)
        for k, held in enumerate(courses(table, limit, field, other) if limit else []):
            colour, label = (LINE, kind) if other is None else (f"C{k}", kind if k == 0 else None)
            axes.plot(places, held.middle, "--", color=colour, linewidth=1.6, label=label)
    scale_heights(axes)
    axes.set(xlabel=words(field), ylabel=words(figure))
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize=8, labelcolor=axes.xaxis.label.get_color())
    return drawn


def courses(table: Table, figure: str, field: str, other: str | None) -> list[Course]:
    """Medians of a figure at a factor's values and its spread over all else, for each value of another factor if there is one."""
    values = distinct(row[field] for row in table)
    found = []
    for group in [None] if other is None else distinct(row[other] for row in table):
        chosen = [row for row in table if other is None or row[other] == group]
        known = [finite(row.get(figure) for row in chosen if row[field] == value) for value in values]
        middle, low, high = ([of(one) if one.size else np.nan for one in known] for of in (np.median, np.min, np.max))
        label = "median and range" if other is None else f"{words(other)}: {short(group)}"
        found.append(Course(label, np.array(middle), np.array(low), np.array(high)))
    return found


def other_factor(table: Table, field: str, fields: Sequence[str]) -> str | None:
    """Another factor whose values are few enough for a line each."""
    few = (name for name in fields if name != field and 1 < len(distinct(row[name] for row in table)) <= MOST_LINES)
    return next(few, None)


def distinct(values: Iterable[Any]) -> list[Any]:
    """Different values, numbers in their order, others as they come."""
    found = list(dict.fromkeys(values))
    return sorted(found) if numeric(found) else found


def unevenly_spaced(places: Array) -> bool:
    """Whether steps between values grow so much that an axis is better logarithmic."""
    steps = np.diff(places)
    return len(steps) > 1 and places[0] > 0 and steps.max() > WIDE * steps.min()


def scale_heights(axes: Axes) -> None:
    """Let the axis of the figure begin at zero, or be logarithmic where it is tall."""
    heights = np.concatenate([np.asarray(line.get_ydata(), float) for line in axes.get_lines()])
    known = heights[np.isfinite(heights)]
    if known.size and known.min() > 0 and known.max() > TALL * known.min():
        axes.set_yscale("log")
    elif known.size and known.min() >= 0:
        axes.set_ylim(bottom=0)


def short(value: Any) -> str:
    """A factor's value in few letters."""
    if isinstance(value, float):
        return f"{value:.4g}"
    text = str(value)
    return text if len(text) <= 24 else f"{text[:21]}..."


def words(name: str) -> str:
    """A field or figure as people read it: the last part of its name, the unit after a comma."""
    last = " and ".join(field.rpartition(".")[2] for field in name.split("+")) if "." in name else name
    last = last.replace("_rms", "_RMS")
    for unit in UNITS:
        if last.endswith(f"_{unit}"):
            return f"{last[: -len(unit) - 1].replace('_', ' ')}, {unit}"
    return last.replace("_", " ")


UNITS = ("mm", "px", "deg", "dn", "s", "ms", "lux", "ppm")
