"""Sections of a budget on a study's page: waterfalls, tables, and what to mend first."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from recon.files.metrics import shown
from recon.reports import figures, page
from recon.reports.figures import BARS, LINE
from recon.reports.page import Section
from twin.studies import error_budget
from twin.studies.error_budget import Budget, Sum
from twin.studies.study_page import kept_drawing, title

PREDICTED = (
    "Errors as the software propagates them. Of the latency and the speed of sound it gets the size that is drawn: their "
    "ratios test slopes alone. Tolerances that act on wires and scan alike cancel in part, which neither's covariance includes."
)
TICKS, GAP = 8, 0.07  # lengths on the axis at most, and the least distance between them, of all
LEAST = 0.002  # share of the sum's square that gets a bar of its own


def sections(folder: Path, budget: Budget, sums: Sequence[Sum]) -> list[Section]:
    """A section a figure; its waterfall is kept as a PNG file too."""
    made = []
    for one in sums:
        if not np.isfinite([one.added, one.whole]).all():
            lost = ", ".join(part.source for part in one.parts if not part.trials) or "all together"
            made.append(Section(title(budget.figures[one.figure]), [page.paragraph(f"No trial gave figures of {lost}.")]))
            continue
        caption, name = f"Budget of {budget.figures[one.figure]}", f"budget_{one.figure}.png"
        drawing = kept_drawing(folder, name, waterfall(one), caption, error_budget.explained(one))
        blocks = [drawing, page.notices(error_budget.advice(budget, one)), page.table(*_parts(budget, one))]
        if one.predicted:
            blocks.append(page.table(*_predicted(one)))
        made.append(Section(title(budget.figures[one.figure]), blocks))
    return made


def waterfall(one: Sum) -> Figure:
    """Squares of the parts, each on top of those before it, up to their sum, beside the whole."""
    kept = [part for part in one.parts if part.alone**2 > LEAST * one.added**2]
    rest = np.sqrt(max(one.added**2 - sum(part.alone**2 for part in kept), 0.0))
    names, sizes = [part.source for part in kept], [part.alone for part in kept]
    if len(kept) < len(one.parts):
        names, sizes = [*names, "all others"], [*sizes, float(rest)]
    squares = np.square(sizes)
    starts = np.concatenate([[0.0], np.cumsum(squares)])[:-1]
    drawn, axes = figures.blank(5.6, 0.9 + 0.3 * (len(names) + 2))
    rows = np.arange(len(names))
    axes.barh(rows, squares, left=starts, color=BARS, height=0.62)
    axes.barh([len(names), len(names) + 1], [one.added**2, one.whole**2], color=[BARS, LINE], height=0.62)
    for row, (start, square, size) in enumerate(zip(starts, squares, sizes, strict=True)):
        axes.text(start + square, row, f" {size:.3f}", va="center", fontsize=8, color=axes.xaxis.label.get_color())
    least, most = max(one.whole - one.uncertainty, 0.0), one.whole + one.uncertainty
    reach = [[one.whole**2 - least**2], [most**2 - one.whole**2]]
    axes.errorbar([one.whole**2], [len(names) + 1], xerr=reach, color=axes.xaxis.label.get_color(), capsize=3, linewidth=1.2)
    for row, value, end in ((len(names), one.added, one.added), (len(names) + 1, one.whole, most)):
        axes.text(end**2, row, f" {value:.3f}", va="center", fontsize=8, color=axes.xaxis.label.get_color())
    axes.set_yticks(range(len(names) + 2), [*names, "sum in squares", "all together, ± 1 sigma"])
    axes.invert_yaxis()
    longest = max(one.added, most)
    ticks = lengths(longest)
    axes.set_xticks(np.square(ticks), [f"{value:g}" for value in ticks])
    axes.set(xlabel="error, mm (squares add up)", xlim=(0, 1.18 * longest**2))
    return drawn


def lengths(longest: float) -> list[float]:
    """Round lengths up to the longest, whose squares stand so far apart that each has room for its figure."""
    room, kept = GAP * longest**2, list[float]()
    for value in MaxNLocator(TICKS, steps=[1, 2, 2.5, 5, 10]).tick_values(0.0, longest):
        if value <= longest and (not kept or value**2 - kept[-1] ** 2 >= room):
            kept.append(round(float(value), 12))
    return kept


def _parts(budget: Budget, one: Sum) -> tuple[list[str], list[list[str]], str]:
    head = ["source", "alone, mm", "± 1 sigma", f"{budget.step:g} times as large, mm", "share of the square, %"]
    rows = [
        [
            part.source,
            shown(part.alone, ".4f"),
            shown(part.uncertainty, ".4f"),
            shown(part.larger, ".4f"),
            f"{100 * part.alone**2 / (one.added**2 or 1):.1f}",
        ]
        for part in one.parts
    ]
    return (
        head,
        rows,
        f"Root mean squares over {error_budget.seeds(one.parts[0].trials)}. "
        "Where a larger source isn't as much larger, it isn't linear.",
    )


def _predicted(one: Sum) -> tuple[list[str], list[list[str]], str]:
    head = ["predicted by the software", "from covariances, mm", "by switching, mm", "ratio"]
    rows = [
        [names, shown(known, ".4f"), shown(switched, ".4f"), shown(known / switched if switched else np.nan, ".2f")]
        for names, (known, switched) in one.predicted.items()
    ]
    return head, rows, PREDICTED
