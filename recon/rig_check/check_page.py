"""`check.html`: verdicts on all parts of the rig, and their course over the days of the log."""

from collections.abc import Sequence

from matplotlib import dates

from recon.reports import figures, page
from recon.reports.page import Opening, Section
from recon.rig_check.check_log import Check, Entry
from recon.rig_check.verdicts import ANEW, PARTS, TITLES

COLOURS = dict(zip(PARTS, ("#5b8db8", "#c8553d", "#d99b2b", "#6a9f58", "#8b6bb1", "#4f9c9c"), strict=True))
WORDS = {
    "good": "as calibrated",
    "moved": "moved",
    "maybe": "moved, or its rival",
    "open": "open",
    "unseen": "not checked",
}
LEAST_SIGMA = 0.01  # of a logarithmic axis
FOOTER = (
    "Deviations are in standard deviations of calibration, usual drift and this check's noise together, as of a normal number. "
    "mm: root mean square over the working volume. This file is complete: it fetches nothing."
)


def write_text(made: Check, log: Sequence[Check], alarm_sigma: float) -> str:
    """The page as HTML."""
    sections = [
        Section("Parts", [page.table(("part", "verdict", "motion", "deviation", "in mm"), map(_row, made.parts))]),
        Section("Over the days", _course(log, alarm_sigma)),
        Section("How to read this", [page.paragraph(text) for text in READING]),
    ]
    return page.render(Opening("Check of the rig", made.name, summary(made.parts), _figures(made)), sections, FOOTER)


READING = (
    "A part has moved where its deviation, had nothing moved, would come by chance in one check of two thousand. Where another "
    "part explains the measurements as well, both are named.",
    "In mm stands the deviation found, and its standard deviation: what is smaller than some of these is not found by this "
    "check. A part is open where the check shows hardly any motion of it, or where cameras that moved have tracked it.",
    "Motions of all devices together, a projector's along its fringes, and a probe's along its own depth do not show. The first "
    "two do no harm; the third the crossed wires show.",
)


def summary(parts: Sequence[Entry]) -> str:
    """One sentence: what has moved, and what is to be done."""
    moved = [one for one in parts if one.state == "moved"]
    if moved:
        named = ", ".join(" or ".join(TITLES[name] for name in (one.part, *one.rivals)) for one in moved)
        return f"Moved: {named}. Run {', '.join(anew(parts))}."
    if checked := [TITLES[one.part] for one in parts if one.state == "good"]:
        return f"As calibrated: {', '.join(checked)}."
    return "Nothing could be checked."


def anew(parts: Sequence[Entry]) -> list[str]:
    """Calibrations that are to be made again, in their order."""
    needed = {ANEW[one.part] for one in parts if one.state in ("moved", "maybe")}
    return [verb for verb in dict.fromkeys(ANEW.values()) if verb in needed]


def deviation(one: Entry) -> tuple[str, str]:
    """A part's deviation in standard deviations and in mm, with that of the latter."""
    if one.sigma is None or one.mm is None or one.mm_sigma is None:
        return "", ""
    return f"{one.sigma:.1f} σ", f"{one.mm:.3f} ± {one.mm_sigma:.3f} mm"


def _row(one: Entry) -> tuple[str, ...]:
    return (TITLES[one.part], WORDS[one.state], one.motion, *deviation(one))


def _figures(made: Check) -> list[tuple[str, str, str]]:
    worst = max((one.sigma for one in made.parts if one.sigma is not None), default=0.0)
    moved = sum(one.state == "moved" for one in made.parts)
    checked = sum(one.state != "unseen" for one in made.parts)
    return [("parts checked", str(checked), ""), ("moved", str(moved), ""), ("largest deviation", f"{worst:.1f}", "σ")]


def _course(log: Sequence[Check], alarm_sigma: float) -> list[str]:
    """Deviations of all checks in the log, in standard deviations and in mm."""
    lines = {"sigma": (f"alarm at {alarm_sigma:g}", "deviation, σ"), "mm": ("", "deviation, mm")}
    return [_plot(log, field, label, alarm_sigma if bound else None) for field, (bound, label) in lines.items()]


def _plot(log: Sequence[Check], field: str, label: str, bound: float | None) -> str:
    figure, axes = figures.blank(7.0, 2.8)
    for part in PARTS:
        points = [(made.time, getattr(one, field)) for made in log for one in made.parts if one.part == part]
        points = [(time, max(value, LEAST_SIGMA / 10)) for time, value in points if value is not None]
        if points:
            axes.plot(*zip(*points, strict=True), "o-", color=COLOURS[part], markersize=3.6, linewidth=1.1, label=TITLES[part])
    if bound is not None:
        axes.axhline(bound, color=figures.LINE, linewidth=1.3, linestyle="--")
    axes.set(ylabel=label, yscale="log")
    locator = dates.AutoDateLocator()
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(dates.ConciseDateFormatter(locator))
    if axes.lines:
        axes.legend(frameon=False, labelcolor=figures.TEXT, fontsize=8, ncols=3)
    axes.spines[["top", "right"]].set_visible(False)
    caption = "Deviation in standard deviations" if bound is not None else "Deviation over the working volume"
    return page.drawing(figures.inline_svg(figure), caption, f"{len(log)} checks.")
