"""Plots of a study: a figure over a factor, with its spread, and its closed form."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill
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
TICKS = 6  # of an even axis, so that numbers of many digits stay apart
MOST_VALUES = 24  # of a factor; more are drawn as points
WIDE = 1.5  # ratio of the largest to the smallest step between values, above which an axis is logarithmic
LETTERS = 38  # in a line beside an axis
CROWDED = 60  # letters below an axis, above which its words stand upright
ASIDE = 0.14  # of the distance between words on an axis: that between courses over one of them
ABOVE = 1.1  # end of an axis from zero, over its largest figure: no marker lies on the edge
TALL = 8.0  # ratio of the largest to the smallest figure, likewise


@dataclass(frozen=True)
class Name:
    """A figure for people."""

    title: str  # with its unit
    reported: tuple[float, float] | None = None  # by the paper, least and greatest


@dataclass(frozen=True)
class Course:
    """A figure over a factor's values : (n,)."""

    label: str
    middle: Array  # median
    low: Array  # least
    high: Array  # greatest


def draw(
    table: Table,
    figure: str,
    field: str,
    fields: Sequence[str],
    limit: str,
    kind: str = "closed form",
    name: Name | None = None,
) -> Figure:
    """Draw a figure over a factor.

    Few values of another factor get a line each; a factor with many values, as of a space-filling design, is a cloud of points.
    Between values that are words there is no line, and at a single number nothing to draw one along.

    Parameters
    ----------
    fields : all factors
    limit : what the figure is held against, also a column of the table, or ""
    kind : of the limit, for the legend
    name : of the figure for people, with what the paper reports of it
    """
    name = name or Name(words(figure))
    table, title = comparable(table, figure, limit, name)
    drawn, axes = figures.blank(5.2, 3.3)
    values = distinct(row[field] for row in table)
    if len(values) > MOST_VALUES and numeric(values):
        _cloud(axes, table, field, {figure: "a trial"} | ({limit: kind} if limit else {}))
    else:
        other = other_factor(table, field, fields)
        found, held = courses(table, figure, field, other), courses(table, limit, field, other) if limit else []
        if len(values) > 1 and numeric(values):
            _along(axes, np.array(values, float), found, held, kind)
        else:
            _beside(axes, [short(value) for value in values], found, held, kind)
    for k, value in enumerate(dict.fromkeys(name.reported or ())):
        colour, label = axes.xaxis.label.get_color(), None if k else "paper reported"
        axes.axhline(value, color=colour, linestyle=(0, (7, 4)), linewidth=1.0, label=label)
    scale_heights(axes)
    axes.set(xlabel=words(field), ylabel=fill(title, LETTERS))
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize=8, labelcolor=axes.xaxis.label.get_color())
    return drawn


def comparable(table: Table, figure: str, limit: str, name: Name) -> tuple[Table, str]:
    """A table and the figure's title for what it is held against: sizes, which are positive, beside a figure of both signs."""
    signed = any(row.get(figure) is not None and row[figure] < 0 for row in table)
    if not (signed and (limit or name.reported)):
        return table, name.title
    return [{**row, figure: abs(row.get(figure, np.nan))} for row in table], f"size of {name.title}"


def _cloud(axes: Axes, table: Table, field: str, labels: Mapping[str, str]) -> None:
    """Figures of all trials over a factor : {figure: label}, the first one's by dots."""
    for k, (name, label) in enumerate(labels.items()):
        x, y = (np.array([row.get(key, np.nan) for row in table], float) for key in (field, name))
        axes.plot(x, y, "x" if k else "o", color=LINE if k else "C0", markersize=3, label=label, clip_on=False)


def _along(axes: Axes, places: Array, found: Sequence[Course], held: Sequence[Course], kind: str) -> None:
    """Courses over numbers : (n,), and what they are held against, dashed."""
    if unevenly_spaced(places):
        axes.set_xscale("log")
        axes.set_xticks(places, [short(place) for place in places.tolist()])
        axes.minorticks_off()
    else:
        axes.locator_params(axis="x", nbins=TICKS)
    for k, one in enumerate(found):
        axes.fill_between(places, one.low, one.high, color=f"C{k}", alpha=0.18, linewidth=0)
        axes.plot(places, one.middle, "o-", color=f"C{k}", markersize=4, linewidth=1.4, label=one.label, clip_on=False)
    for k, one in enumerate(held):
        axes.plot(places, one.middle, "--", color=_colour(k, held), linewidth=1.6, label=None if k else kind)


def _beside(axes: Axes, values: Sequence[str], found: Sequence[Course], held: Sequence[Course], kind: str) -> None:
    """Courses over words, beside each other, with their ranges as bars, and what they are held against as strokes."""
    places, aside = np.arange(len(values)), ASIDE * (np.arange(len(found)) - (len(found) - 1) / 2)
    axes.set_xticks(places, values, rotation=90 if sum(map(len, values)) > CROWDED else 0)
    axes.set_xlim(-0.5, len(values) - 0.5)
    for k, one in enumerate(found):
        axes.vlines(places + aside[k], one.low, one.high, color=f"C{k}", alpha=0.35, linewidth=5)
        axes.plot(places + aside[k], one.middle, "o", color=f"C{k}", markersize=5, label=one.label, clip_on=False)
    for k, one in enumerate(held):
        style = {"color": _colour(k, held), "markersize": 18, "markeredgewidth": 1.8, "label": None if k else kind}
        axes.plot(places + aside[k], one.middle, "_", **style, clip_on=False)


def _colour(k: int, held: Sequence[Course]) -> str:
    """Of what the k-th course is held against: its own where there are several."""
    return LINE if len(held) == 1 else f"C{k}"


def courses(table: Table, figure: str, field: str, other: str | None) -> list[Course]:
    """Medians of a figure at a factor's values and its spread over all else, for each value of another factor if there is one."""
    values = distinct(row[field] for row in table)
    found = []
    for group in [None] if other is None else distinct(row[other] for row in table):
        chosen = [row for row in table if other is None or row[other] == group]
        known = [finite(row.get(figure) for row in chosen if row[field] == value) for value in values]
        middle, low, high = ([of(one) if one.size else np.nan for one in known] for of in (np.median, np.min, np.max))
        alone = "median and range" if any(one.size > 1 for one in known) else "a trial"
        label = alone if other is None else f"{words(other)}: {short(group)}"
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
        axes.set_ylim(0.0, max(axes.get_ylim()[1], ABOVE * known.max()))


def short(value: Any) -> str:
    """A factor's value in few letters."""
    if isinstance(value, float):
        return f"{value:.4g}"
    text = str(value)
    return text if len(text) <= 24 else f"{text[:21]}..."


def words(name: str) -> str:
    """A field or figure as people read it: the last part of its name, whose method's it is, and the unit, after commas."""
    last = " and ".join(field.rpartition(".")[2] for field in name.split("+")) if "." in name else name
    last = re.sub(r"^cr(?=\d)", "CR", last.replace("_rms", "_RMS"))
    after = ""
    for ending, shown in ENDINGS:
        if last.endswith(f"_{ending}"):
            last, after = last.removesuffix(f"_{ending}"), f", {shown}{after}"
    return last.replace("_", " ") + after


UNITS = {
    **{
        "mm_s": "mm/s",
        "m_s": "m/s",
        "e_per_s": "e/s",
        "per_m": "1/m",
        "mm": "mm",
        "um": "µm",
        "nm": "nm",
        "px": "px",
        "deg": "deg",
    },
    **{"dn": "DN", "ms": "ms", "s": "s", "hz": "Hz", "lux": "lux", "ppm": "ppm", "percent": "%", "w": "W"},
}
ENDINGS = (*UNITS.items(), ("ours", "ours"), ("paper", "paper's method"))  # of names, in the order in which they are taken off
