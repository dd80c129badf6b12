"""Sections of shares on a study's page: by level with intervals, and what the distance is made of."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from recon.reports import figures, page
from recon.reports.page import Section
from twin.studies import budget_page, shares
from twin.studies.shares import CONFIDENCE, Share, Shares
from twin.studies.study_page import kept_drawing
from twin.studies.study_plots import words
from twin.studies.study_runs import Done

Level = tuple[str, Any, dict[str, Share]]


def sections(folder: Path, wanted: Shares, done: Sequence[Done]) -> list[Section]:
    """Shares by level, with a drawing, and the error's parts; both drawings are kept as PNG files too."""
    levels = list(shares.by_level(wanted, done))
    if not levels[0][2][next(iter(wanted.counts))].trials:
        return [Section("Shares", [page.paragraph("No trial gave figures.")])]
    drawing = kept_drawing(
        folder, "shares.png", draw(wanted, levels), f"Shares with {CONFIDENCE:.0%} intervals", "The unit is the patient."
    )
    head = ["", "patients", "refused", *(f"{text}, %" for text in wanted.counts.values())]
    rows = [
        [_name(level), str(any_of.trials), str(any_of.refused), *map(in_words, level[2].values())]
        for level in levels
        for any_of in [next(iter(level[2].values()))]
    ]
    caption = (
        f"In brackets: Wilson's intervals of {CONFIDENCE:.0%}, with what counts of one patient have in common. Refused patients, "
        "such as those whose target was lost, have no plan and count in no share."
    )
    one = shares.parts(wanted, done)
    made = [Section("Shares", [drawing, page.table(head, rows, caption)])]
    if wanted.without:
        title = "Parts of the distance, root mean square"
        waterfall = kept_drawing(folder, "parts.png", budget_page.waterfall(one), title, "Each by leaving it out.")
        left = [
            [
                part.source,
                f"{np.sqrt(max(one.whole**2 - part.alone**2, 0.0)):.2f}",
                f"{100 * part.alone**2 / one.whole**2:.1f} ± {100 * part.larger / one.whole**2:.1f}",
            ]
            for part in one.parts
        ]
        table = page.table(["part", "without it, mm", "of the square, % ± 1 sigma"], left, f"With all parts: {one.whole:.2f} mm.")
        made.append(Section("What the distance is made of", [waterfall, table]))
    return made


def in_words(one: Share) -> str:
    """A share in per cent, and its interval in brackets."""
    return f"{100 * one.value:.0f} ({100 * one.low:.0f} to {100 * one.high:.0f})"


def draw(wanted: Shares, levels: Sequence[Level]) -> Figure:
    """Shares and their intervals, a row a level, levels of a factor side by side."""
    drawn, axes = figures.blank(6.0, 1.0 + 0.34 * len(levels))
    rows = np.arange(len(levels)) + 0.6 * np.cumsum([k > 0 and levels[k][0] != levels[k - 1][0] for k in range(len(levels))])
    for k, (name, text) in enumerate(wanted.counts.items()):
        found = [level[2][name] for level in levels]
        values = 100 * np.array([one.value for one in found])
        reach = np.abs(100 * np.array([[one.low for one in found], [one.high for one in found]]) - values)
        axes.errorbar(values, rows, xerr=reach, fmt="o", color=f"C{k}", markersize=5, capsize=3, linewidth=1.3, label=text)
    axes.set_yticks(rows, [_name(level) for level in levels])
    axes.invert_yaxis()
    axes.set(xlabel=f"share, % ({CONFIDENCE:.0%} intervals)", xlim=(0, 100))
    axes.grid(alpha=0.25, axis="x")
    axes.legend(
        frameon=False, fontsize=8, labelcolor=axes.xaxis.label.get_color(), ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0)
    )
    return drawn


def _name(level: Level) -> str:
    field, value, _ = level
    return f"{words(field)}: {str(value).replace('_', ' ')}" if field else "all"
