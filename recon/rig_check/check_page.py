"""`check.html`: verdicts on all parts of the rig and on its numbers, and their course over the days of the log."""

from collections.abc import Sequence
from datetime import datetime, timedelta
from math import erfc
from typing import NamedTuple

from matplotlib import dates, ticker
from matplotlib.axes import Axes

from recon.reports import figures, page
from recon.reports.page import Opening, Section
from recon.rig_check import control_charts, rig_versions
from recon.rig_check.check_log import Check, Entry
from recon.rig_check.control_charts import Chart
from recon.rig_check.rig_versions import Comparison
from recon.rig_check.verdicts import ANEW, PARTS, TITLES

COLOURS = dict(zip(PARTS, ("#5b8db8", "#c8553d", "#d99b2b", "#6a9f58", "#8b6bb1", "#4f9c9c"), strict=True))
WORDS = {
    "good": "as calibrated",
    "moved": "moved",
    "maybe": "moved, or its rival",
    "open": "open",
    "unseen": "not checked",
}


class Axis(NamedTuple):
    """A logarithmic axis of deviations; those below its floor are drawn there."""

    field: str  # of `Entry`
    unit: str
    floor: float
    top: float  # at least

    def caption(self, log: Sequence[Check]) -> str:
        """The number of checks, and the reading of the lowest points."""
        checks = f"{len(log)} check{'s' * (len(log) != 1)}"
        low = f"Points at {self.floor:g} {self.unit} are at or below it."
        return f"{checks}, times in UTC; marks of one check stand side by side. {low}"


SIGMA, LENGTH = Axis("sigma", "σ", 0.1, 10.0), Axis("mm", "mm", 0.01, 1.0)
ASIDE = timedelta(hours=6)  # of time left free beside the first and the last check
MARGIN = 0.03  # of the time between them, if that is more
BESIDE = 0.01  # of the axis of time between the marks of two parts in one check, or less where checks are close
FOOTER = (
    "Deviations are in standard deviations of calibration, usual drift and this check's noise together, as of a normal number. "
    "mm: root mean square over the working volume. This file is complete: it fetches nothing."
)


def write_text(made: Check, log: Sequence[Check], alarm_sigma: float) -> str:
    """The page as HTML."""
    charts = control_charts.charts(log, alarm_sigma)
    numbers = [] if made.rig is None else [Section("Numbers of the rig", _numbers(made.rig, log))]
    sections = [
        Section("Parts", [page.table(("part", "verdict", "motion", "limit, 1 σ", "deviation", "in mm"), map(_row, made.parts))]),
        *numbers,
        *([Section("Over the days", _course(log, alarm_sigma))] if any(map(_shows_parts, log)) else []),
        *([Section("Control charts", _control(charts, log))] if charts else []),
        Section("How to read this", [page.paragraph(text) for text in reading(alarm_sigma)]),
    ]
    return page.render(Opening("Check of the rig", made.name, summary(made, charts), _figures(made)), sections, FOOTER)


def reading(alarm_sigma: float) -> tuple[str, ...]:
    """What the numbers mean."""
    by_chance = 1 / erfc(alarm_sigma / 2**0.5)
    return (
        f"A part has moved where its deviation, had nothing moved, would come by chance in one check of {by_chance:.0f}. Where "
        "another part explains the measurements as well, both are named.",
        "The limit is that of this check, not an error of the deviation beside it: one standard deviation of the motions that "
        "the recording leaves possible, whatever was found. Motions below some of these pass unseen. A part is open where the "
        "limit is nearly a usual motion, or where cameras that moved have tracked it.",
        "Motions of all devices together, a projector's along its fringes, and a probe's along its own depth do not show. The "
        "first two do no harm; the third the crossed wires show.",
    )


def summary(made: Check, charts: Sequence[Chart] = ()) -> str:
    """What has moved, drifted or changed, and what is to be done, in some sentences."""
    parts, told = made.parts, list[str]()
    moved = [one for one in parts if one.state == "moved"]
    if moved:
        named = ", ".join(" or ".join(TITLES[name] for name in (one.part, *one.rivals)) for one in moved)
        told = [f"Moved: {named}. Run {', '.join(anew(parts))}."]
    else:
        names = {state: ", ".join(TITLES[one.part] for one in parts if one.state == state) for state in ("good", "open")}
        told = [f"{word}: {names[state]}." for state, word in (("good", "As calibrated"), ("open", "Open")) if names[state]]
        drifting = control_charts.drifting(charts)
        if drifting:
            named = "; ".join(f"{' or '.join(TITLES[one.part] for one in rivals)} {rivals[0].told}" for rivals in drifting)
            verbs = _verbs([[one.part for one in rivals] for rivals in drifting])
            told += [f"Out of control over the days: {named}. Run {', '.join(verbs)}."]
    if made.rig is not None and made.rig.changed:
        told += [f"Changed: {rig_versions.told(made.rig.changed)}. If it is meant, go on with today's file of the rig."]
    elif made.rig is not None:
        told += [f"Numbers of the rig as in {made.rig.before.text}."]
    return " ".join(told) or "Nothing could be checked."


def anew(parts: Sequence[Entry]) -> list[str]:
    """Calibrations that are to be made again, in their order."""
    return _verbs([[one.part for one in parts if one.state in ("moved", "maybe")]])


def _verbs(groups: Sequence[Sequence[str]]) -> list[str]:
    needed = {ANEW[part] for group in groups for part in group}
    return [verb for verb in dict.fromkeys(ANEW.values()) if verb in needed]


class Shown(NamedTuple):
    """A part's numbers in words, empty where nothing showed it."""

    deviation: str  # in standard deviations
    mm: str
    limit: str  # of this check, one standard deviation: smaller motions aren't found


def shown(one: Entry) -> Shown:
    """A part's numbers in words."""
    if one.sigma is None or one.mm is None or one.mm_sigma is None:
        return Shown("", "", "")
    return Shown(f"{one.sigma:.1f} σ", f"{one.mm:.3f} mm", f"{one.mm_sigma:.3f} mm")


def lines(made: Check) -> list[str]:
    """A head and a line a part, and if the rig's numbers were compared a line a device, for the terminal."""
    head = _line(("part", "verdict", "deviation", "in mm", "limit, 1 σ", "motion"))
    return [head, *map(_line_of, made.parts), *([] if made.rig is None else _number_lines(made.rig))]


def _number_lines(rig: Comparison) -> list[str]:
    """A line on the files, and one a device with what has changed most of it, and all that has."""
    found = []
    for device in dict.fromkeys(one.device for one in rig.numbers):
        own = [one for one in rig.numbers if one.device == device]
        changed = [one for one in own if one.changed]
        words = "; ".join(f"{one.title} {one.change}, {one.sigma:.1f} σ" for one in changed)
        verdict, deviation = ("changed" if changed else f"{len(own)} as in rig"), max(one.sigma for one in own)
        found.append(_line((f"{TITLES.get(device, device)}, numbers", verdict, f"{deviation:.1f} σ", "", "", words)))
    return [f"rig         {_compared(rig)}", *found]


def _compared(rig: Comparison) -> str:
    """The files, and how many numbers of them."""
    over = f"; {rig.taken_over} taken over from the file" if rig.taken_over else ""
    if rig.without_covariance:
        named = ", ".join(TITLES.get(device, device) for device in rig.without_covariance)
        over += f"; not compared, as a file has no covariance: optics of {named}"
    return f"{rig.today.text} against {rig.before.text}: {len(rig.numbers)} numbers, limit {rig.limit_sigma:.1f} σ{over}"


def _numbers(rig: Comparison, log: Sequence[Check]) -> list[str]:
    """All numbers by device, their meaning, and the largest deviations over the days."""
    head = ("device", "number", "verdict", "change", "deviation")
    rows = [
        (
            TITLES.get(one.device, one.device),
            one.title,
            "changed" if one.changed else "as in rig",
            one.change,
            f"{one.sigma:.1f} σ",
        )
        for one in rig.numbers
    ]
    reading = (
        f"A number has changed where its deviation is beyond {rig.limit_sigma:.1f} σ: of a rig that has not changed, one "
        f"comparison of {1 / rig.chance:.0f} flags any. Optics and place of a device are compared as a whole each, as errors of "
        "their numbers go together; usual drift is in it. Numbers that were not measured in both files do not count."
    )
    worst = [one.model_copy(update={"parts": _largest(one.rig)}) for one in log if one.rig is not None]
    seen = {part.part for one in worst for part in one.parts}
    caption = f"Dashed: today's limit of {rig.limit_sigma:.1f} σ. {SIGMA.caption(worst)}"
    drawing = page.drawing(_plot(worst, SIGMA, rig.limit_sigma), "The largest deviation of each device's numbers", caption)
    key = page.key({TITLES[part]: COLOURS[part] for part in PARTS if part in seen})
    return [page.table(head, rows, f"{_compared(rig)}."), page.paragraph(reading), key, drawing]


def _largest(rig: Comparison) -> tuple[Entry, ...]:
    """The largest deviation of each device's numbers, as of a part."""
    devices = {one.device for one in rig.numbers}
    largest = {part: max(one.sigma for one in rig.numbers if one.device == part) for part in PARTS if part in devices}
    return tuple(Entry(part=part, state="good", sigma=sigma) for part, sigma in largest.items())


def _line_of(one: Entry) -> str:
    deviation, mm, limit = shown(one)
    rivals = f" (or {', '.join(TITLES[name] for name in one.rivals)})" if one.rivals else ""
    return _line((TITLES[one.part], WORDS[one.state], deviation, mm, limit, one.motion + rivals))


def _line(cells: Sequence[str]) -> str:
    """Cells in columns, the numbers to the right."""
    part, verdict, *numbers, motion = cells
    return f"{part:22}{verdict:19}{''.join(f'{number:>12}' for number in numbers)}  {motion}".rstrip()


def _row(one: Entry) -> tuple[str, ...]:
    deviation, mm, limit = shown(one)
    return (TITLES[one.part], WORDS[one.state], one.motion, limit, deviation, mm)


def _figures(made: Check) -> list[tuple[str, str, str]]:
    numbers = () if made.rig is None else made.rig.numbers
    worst = max((one.sigma for one in (*made.parts, *numbers) if one.sigma is not None), default=0.0)
    moved = sum(one.state == "moved" for one in made.parts)
    checked = sum(one.state != "unseen" for one in made.parts)
    figures = [("parts checked", str(checked), ""), ("moved", str(moved), ""), ("largest deviation", f"{worst:.1f}", "σ")]
    if made.rig is not None:
        figures += [("numbers compared", str(len(made.rig.numbers)), ""), ("changed", str(len(made.rig.changed)), "")]
    return figures


def _shows_parts(made: Check) -> bool:
    return any(one.sigma is not None for one in made.parts)


def _control(charts: Sequence[Chart], log: Sequence[Check]) -> list[str]:
    """Control charts of all parts, with their state in words."""
    limit = charts[0].limits
    rows = [
        (
            TITLES[one.part],
            f"{one.sigma[-1]:.1f} σ",
            f"{one.cusum[-1]:.1f}, limit {one.limits.cusum:.1f}",
            one.told if one.out else "in control",
        )
        for one in charts
    ]
    table = page.table(("part", "today beside all earlier", "cumulative sum", "state"), rows)
    charted = {one.part for one in charts}
    old = sum(any(one.sigma is not None and one.estimate is None and one.part in charted for one in made.parts) for made in log)
    left_out = (
        f"{old} check{'s' * (old != 1)} of the log have no motions beside deviations, as they are of an earlier version, or were "
        "tracked by cameras that moved: they aren't in the charts."
    )
    again = len({time for one in charts for time in one.repeated})
    repeated = (
        "1 check of a recording that was checked before doesn't count."
        if again == 1
        else f"{again} checks of a recording that was checked before don't count."
    )
    drawings = [
        page.drawing(_control_plot(one), TITLES[one.part], f"{len(one.times)} checks since {one.times[0]:%Y-%m-%d}.")
        for one in charts
    ]
    key = page.key({"one check, beside all earlier": figures.BARS, "cumulative sum": figures.LINE})
    reading = (
        "Here the calibration's error cancels, as it is the same in all checks by one calibration: each check's motion is held "
        "against the mean of the earlier ones, in standard deviations of noise and usual drift. A cumulative sum shows what goes "
        f"on slowly in one direction. While nothing drifts, each passes its limit once in {limit.run_length:.0f} checks: "
        f"one check {limit.sigma:.1f} σ, the sum that in the table. Of parts that are seen together, all may be beyond where one "
        "drifts.",
        *([left_out] if old else []),
        *([repeated] if again else []),
    )
    return [*map(page.paragraph, reading), table, key, page.grid(drawings, "two")]


def _control_plot(chart: Chart) -> str:
    """Both charts over time, over their limits."""
    figure, axes = figures.blank(4.8, 2.4)
    one, total = chart.sigma / chart.limits.sigma, chart.cusum / chart.limits.cusum
    axes.plot(chart.times, total, "-", color=figures.LINE, linewidth=1.4)
    axes.plot(chart.times, one, "o", color=figures.BARS, markersize=3.0)
    axes.axhline(1.0, color=figures.TEXT, linewidth=1.0, linestyle="--")
    axes.set(ylabel="over its limit", xlim=_ends(chart.times), ylim=(0, 1.1 * max(1.2, one.max(), total.max())))
    _date(axes)
    return figures.inline_svg(figure)


def _course(log: Sequence[Check], alarm_sigma: float) -> list[str]:
    """Deviations of all checks in the log, in standard deviations and in mm."""
    seen = {one.part for made in log for one in made.parts if one.sigma is not None}
    key = page.key({TITLES[part]: COLOURS[part] for part in PARTS if part in seen})
    alarm = f"Dashed: alarm at {alarm_sigma:g} σ. {SIGMA.caption(log)}"
    return [
        key,
        page.drawing(_plot(log, SIGMA, alarm_sigma), "Deviation in standard deviations", alarm),
        page.drawing(_plot(log, LENGTH), "Deviation over the working volume", LENGTH.caption(log)),
    ]


def span(log: Sequence[Check]) -> tuple[datetime, datetime]:
    """Ends of the axis of time."""
    return _ends([made.time for made in log])


def _ends(times: Sequence[datetime]) -> tuple[datetime, datetime]:
    first, last = min(times), max(times)
    margin = max(ASIDE, MARGIN * (last - first))
    return first - margin, last + margin


def _plot(log: Sequence[Check], axis: Axis, alarm: float | None = None) -> str:
    """Deviations over time, a line a part; marks of one check stand beside each other, so that none hides another."""
    figure, axes = figures.blank(7.0, 2.8)
    start, end = span(log)
    step = min(BESIDE, 0.5 / (len(PARTS) * len(log))) * (end - start)
    top = max(axis.top, 1.5 * (alarm or 0.0))
    for k, part in enumerate(PARTS):
        aside = (k - (len(PARTS) - 1) / 2) * step
        points = [(made.time, getattr(one, axis.field)) for made in log for one in made.parts if one.part == part]
        points = [(time + aside, max(value, axis.floor)) for time, value in points if value is not None]
        if points:
            axes.plot(*zip(*points, strict=True), "o-", color=COLOURS[part], markersize=3.6, linewidth=1.0)
            top = max(top, *(2 * value for _, value in points))
    if alarm is not None:
        axes.axhline(alarm, color=figures.TEXT, linewidth=1.0, linestyle="--")
    axes.set(ylabel=f"deviation, {axis.unit}", yscale="log", xlim=(start, end), ylim=(0.8 * axis.floor, top))
    axes.yaxis.set_major_formatter(ticker.StrMethodFormatter("{x:g}"))
    _date(axes)
    return figures.inline_svg(figure)


def _date(axes: Axes) -> None:
    """Write dates along the axis of time."""
    locator = dates.AutoDateLocator(minticks=3, maxticks=8)
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(dates.ConciseDateFormatter(locator))
    axes.spines[["top", "right"]].set_visible(False)
