"""Section of a search on a study's page: the best so far over the candidates, and the best ones."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from recon.files.metrics import shown
from recon.reports import figures, page
from recon.reports.figures import BARS, LINE
from recon.reports.page import Section
from twin.studies import rig_search
from twin.studies.rig_search import Candidate, Goal
from twin.studies.study_page import PICTURES, kept_drawing
from twin.studies.study_plots import scale_heights, short, words

CROSSES = ("x", "+", "1", "2", "3", "4")  # markers of candidates out of bounds, one a bound
BEST = 10  # candidates in the table


def sections(folder: Path, goal: Goal, candidates: Sequence[Candidate]) -> list[Section]:
    """The search's course, kept as a PNG file too, and its best candidates."""
    drawing = kept_drawing(folder, "search.png", course(goal, candidates), "The search", f"{PICTURES}/search.png")
    start = [page.paragraph(no_start(candidates[0]))] if goal.start and candidates[0].lost else []
    good = sorted((one for one in candidates if one.good), key=lambda one: one.value)[:BEST]
    if not good:
        return [Section("Search", [*start, page.paragraph("No candidate kept all bounds."), drawing])]
    head = [*map(words, good[0].point), words(goal.least), *(f"{words(name)}, in the worst" for name in goal.bounds)]
    rows = [
        [*map(short, one.point.values()), shown(one.value, ".4g"), *(f"{one.bound[name]:.4g}" for name in goal.bounds)]
        for one in good
    ]
    return [Section("Search", [*start, drawing, page.table(head, rows, "The best candidates within all bounds.")])]


def no_start(start: Candidate) -> str:
    """That nothing can be said of the start, and why, in words."""
    return f"The start gives no figures, so no improvement on it can be stated: {start.lost}"


def course(goal: Goal, candidates: Sequence[Candidate]) -> Figure:
    """Values of the candidates in their order, and the best of those within all bounds so far."""
    values = np.array([one.value for one in candidates])
    good = np.array([one.good for one in candidates])
    best = np.minimum.accumulate(np.where(good, values, np.inf))
    numbers = np.arange(1, len(values) + 1)
    drawn, axes = figures.blank(5.2, 3.3)
    known, out = np.isfinite(values), [rig_search.missed(goal, one) for one in candidates]
    axes.plot(numbers[good], values[good], "o", color=BARS, markersize=4, label="within all bounds", clip_on=False)
    for k, name in enumerate(goal.bounds):
        chosen = known & np.array([missed == name for missed in out])
        if chosen.any():
            style = {"color": f"C{k + 1}", "markersize": 5, "label": f"out of bounds: {words(name)}"}
            axes.plot(numbers[chosen], values[chosen], CROSSES[k % len(CROSSES)], linestyle="none", **style, clip_on=False)
    axes.plot(numbers, np.where(np.isfinite(best), best, np.nan), color=LINE, drawstyle="steps-post", label="best so far")
    scale_heights(axes)
    if not known.all():  # at the upper edge, whatever the scale
        lost, style = numbers[~known], {"color": axes.xaxis.label.get_color(), "markersize": 6, "label": "no figures"}
        top = axes.get_xaxis_transform()
        axes.plot(lost, np.ones(len(lost)), "v", fillstyle="none", transform=top, clip_on=False, **style)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axes.set(xlabel="candidate", ylabel=words(goal.least), xlim=(0.5, len(values) + 0.5))
    axes.legend(frameon=False, fontsize=8, labelcolor=axes.xaxis.label.get_color())
    return drawn
