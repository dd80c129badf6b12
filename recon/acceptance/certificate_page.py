"""`certificate.html`: verdict, test values against their limits, uncertainty budgets, the arrangement, and lines to sign."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from recon.acceptance.certificates import Artefacts
from recon.acceptance.gum_budget import Budget
from recon.acceptance.optical_acceptance import CHARACTERISTICS, Acceptance, Judged
from recon.reports import figures, page
from recon.reports.page import Opening, Section

COLOURS = {"accepted": "#3f8f4f", "rejected": "#c8553d", "neither": "#d99b2b", None: "#8a94a0"}
UNSIGNED = "to be filled in"
HEAD = ("quantity", "ISO 10360-13", "worst place", "limit (MPE)", "decision", "error ± U")
BUDGET_HEAD = ("input", "type", "value", "standard uncertainty", "sensitivity", "contribution", "share of variance")
DEMAND_HEAD, ARTEFACT_HEAD = ("demand", "found", ""), ("certified", "value", "U")
READING = (
    "A test value is the rig’s error of indication in one place: what another measurement there would show in the mean. U "
    "is its expanded uncertainty for 95 %: certificates, temperature, paint, mounting, and the noise of this measurement, "
    "which ISO 14253-5 would leave out. Errors of the rig’s calibration are what is tested, and are not in U. What a whole "
    "sequence shifts alike, such as an error of a fringe’s phase, is in U where places were recorded again, for quantities of "
    "these artefacts; one sequence in each place does not show it: then it is in the values alone.",
    "Decisions are by ISO 14253-1: accepted where |error| + U is within the limit, rejected where |error| - U is beyond it; "
    "between them neither is proven. A quantity is accepted where it is in all its places, the rig where all quantities "
    "are.",
    "PF and F are widths of the narrowest shell around all points of a sphere or plane about its least-squares fit, without "
    "the worst 3 in 1000 (VDI/VDE 2634); PF95 and F95 hold 95 % of the points (ISO 10360-13). Such widths grow with the "
    "number of points, PF faster than PF95: compare tests of as many points. PS is the fitted diameter, of free radius and "
    "all points, less the certified one; SD the distance of the fitted centres, and E the length over both balls, by that "
    "and the fitted radii, each less the certified one.",
    "TP is the distance of a tracked tool’s tip from its mean in a divot, root mean square, with the tool at rest or turned; "
    "TD the distance of the tip’s means in two divots less the certified one: tests of ASTM F2554 in kind. An error of the "
    "tip’s calibration counts as the tool’s.",
    "UD is the distance of two filaments of a phantom in B-scans, with depths as of the phantom’s speed of sound, less the "
    "certified one; UL and UA are widths of a filament’s echo at -6 dB, along the array and in depth: tests of IEC 61391-1 in "
    "kind. Each is the mean of several B-scans, for each of which the probe was placed again.",
    "The guidelines are sold, not public. Quantities, numbers of places and sizes of artefacts are as publicly described; "
    "the exact arrangements, and what ISO 10360-13 has beside them (registered views, lengths between points, rules for "
    "repeats), are not reproduced. E is ours: a view from one side does not see a bar’s outer ends.",
)
FOOTER = "Made by sonotwin from measurements and certificates, without ground truth. This file is complete: it fetches nothing."


class Subject(NamedTuple):
    """Who tested what."""

    instrument: str
    operator: str
    day: str
    artefacts: Artefacts


def write_text(found: Acceptance, subject: Subject) -> str:
    """The page as HTML."""
    arrangement = [page.table(DEMAND_HEAD, demand_rows(found)), page.drawing(_map(found, subject), *_MAP)]
    sections = [
        Section("Test values", [page.table(HEAD, result_rows(found)), page.drawing(_plot(found), *_plotted(found))]),
        *([Section("Arrangement", arrangement)] if found.demands else []),
        Section("Uncertainty budgets", _budgets(found)),
        Section("Artefacts", [page.table(ARTEFACT_HEAD, artefact_rows(subject.artefacts), room(subject.artefacts))]),
        Section("All places", [page.table(("quantity", "place", "points", "decision", "error ± U"), place_rows(found))]),
        Section("How to read this", [page.paragraph(text) for text in READING]),
        Section("Signed", [page.table(("", ""), signature_rows(subject))]),
    ]
    return page.render(
        Opening("certificate of acceptance", subject.instrument, verdict(found), _figures(found)), sections, FOOTER
    )


def verdict(found: Acceptance) -> str:
    """The decision in words, with what it rests on."""
    decisions = {symbol: found.decision_of(symbol) for symbol in found.worst_values}
    by = {word: [symbol for symbol, own in decisions.items() if own == word] for word in ("rejected", "neither")}
    limited = sum(one.decision is not None for one in found.values)
    if not limited:
        text = "Reported without a decision: no quantity has a limit."
    elif by["rejected"]:
        text = f"Rejected: {_listed(by['rejected'])} beyond the limit, proven by the uncertainty."
    elif by["neither"]:
        text = f"Neither accepted nor rejected: {_listed(by['neither'])} within the uncertainty of the limit."
    else:
        text = f"Accepted: all {limited} test values keep to their limits, proven by their uncertainties."
    lacking = [one.words for one in found.demands if not one.met]
    return f"{text} Not a whole test by VDI/VDE 2634: {'; '.join(lacking)}." if lacking else text


def result_rows(found: Acceptance) -> list[tuple[str, ...]]:
    """A row a quantity, of the place that decides."""
    return [
        (
            f"{symbol}, {CHARACTERISTICS[symbol].title}",
            CHARACTERISTICS[symbol].iso or "none",
            one.place,
            "none" if one.limit_mm is None else f"{one.limit_mm:g} mm",
            found.decision_of(symbol) or "reported",
            in_words(one.budget),
        )
        for symbol, one in found.worst_values.items()
    ]


def place_rows(found: Acceptance) -> list[tuple[str, ...]]:
    """A row a value."""
    return [
        (one.symbol, one.place, page.count(one.points), one.decision or "reported", in_words(one.budget)) for one in found.values
    ]


def demand_rows(found: Acceptance) -> list[tuple[str, ...]]:
    """A row a demand."""
    return [(one.words, one.found, "met" if one.met else "not met") for one in found.demands]


def budget_rows(budget: Budget) -> list[tuple[str, ...]]:
    """A row an input, the largest share first."""
    return [
        (
            row.input.name,
            f"{row.input.kind}, {row.input.shape if row.input.kind == 'B' or np.isinf(row.input.freedom) else 'Student’s t'}",
            f"{row.input.value:.7g} {row.input.unit}",
            f"{row.input.standard:.2g} {row.input.unit}",
            f"{row.sensitivity:.3g}",
            f"{row.contribution_mm:.2g} mm",
            f"{100 * row.share:.1f} %",
        )
        for row in sorted(budget.rows, key=lambda row: -row.share)
    ]


def budget_summary(one: Judged) -> str:
    """The combined uncertainty in a sentence, and what Monte Carlo says."""
    budget = one.budget
    freedom = "many" if budget.freedom > 999 else f"{budget.freedom:.0f}"
    low, high = budget.drawn_mm
    drawn = f"Monte Carlo: {low:+.4f} to {high:+.4f} mm"
    valid = "validates it" if budget.validated else "differs by more than 5 % of u, so that its farther end is U"
    combined = f"u = {budget.standard_mm:.2g} mm, {freedom} degrees of freedom, k = {budget.k:.2f}"
    return f"{in_words(budget)}. {combined}. {drawn}, which {valid}."


def artefact_rows(artefacts: Artefacts) -> list[tuple[str, str, str]]:
    """A row a certified value."""
    rows, sphere, bar, plane = list[tuple[str, str, str]](), artefacts.sphere, artefacts.bar, artefacts.plane
    if sphere is not None:
        rows += [("sphere, diameter", f"{sphere.diameter.mm:.4f} mm", _certified(sphere.diameter.expanded_mm, sphere.diameter.k))]
        rows += [("sphere, form", f"{sphere.form_mm:.4f} mm", "")]
    if bar is not None:
        named = [("bar, centre to centre", bar.length), *((f"bar, diameter {k + 1}", one) for k, one in enumerate(bar.diameters))]
        rows += [(name, f"{one.mm:.4f} mm", _certified(one.expanded_mm, one.k)) for name, one in named]
    if plane is not None:
        rows += [("plane, form", f"{plane.form_mm:.4f} mm", "")]
    if artefacts.divots is not None:
        expanded = _certified(artefacts.divots.expanded_mm, artefacts.divots.k)
        rows += [("divots, distance of two", f"{len(artefacts.divots.places_mm)} places", expanded)]
    if artefacts.filaments is not None:
        phantom = artefacts.filaments
        expanded = _certified(phantom.expanded_mm, phantom.k)
        rows += [("filaments, distance of two", f"{len(phantom.places_mm)} places", expanded)]
        rows += [("phantom, speed of sound", f"{phantom.speed_m_s:g} m/s", f"± {phantom.speed_limit_m_s:g} m/s")]
    return rows


def signature_rows(subject: Subject) -> list[tuple[str, str]]:
    """Who tested, and lines to sign."""
    return [
        ("instrument", subject.instrument),
        ("tested by", subject.operator or UNSIGNED),
        ("day", subject.day or UNSIGNED),
        ("signature", UNSIGNED),
    ]


def in_words(budget: Budget) -> str:
    """Value and expanded uncertainty, this to two digits and the value as far (GUM 7.2.6)."""
    expanded = budget.expanded_mm
    decimals = int(np.clip(1 - np.floor(np.log10(expanded)), 1, 5)) if expanded > 0 else 4
    return f"{budget.value_mm:.{decimals}f} ± {expanded:.{decimals}f} mm".replace("-", "−")


def room(artefacts: Artefacts) -> str:
    """Temperature and volume in words."""
    warmth = f"Temperature {artefacts.temperature_c:g} ± {artefacts.temperature_limit_c:g} °C; lengths are corrected to it."
    size = " × ".join(f"{side:g}" for side in artefacts.volume.size_mm)
    return f"{warmth} Volume {size} mm, L0 = {artefacts.volume.diagonal_mm:.0f} mm."


def _certified(expanded_mm: float, k: float) -> str:
    return f"{expanded_mm:.4f} mm, k = {k:g}"


def _listed(symbols: Sequence[str]) -> str:
    *others, last = symbols
    return f"{', '.join(others)} and {last} are" if others else f"{last} is"


def _figures(found: Acceptance) -> list[tuple[str, str, str]]:
    numbers = [(symbol, f"{one.budget.value_mm:.3f}".replace("-", "−"), "mm") for symbol, one in found.worst_values.items()]
    return (
        numbers
        if not found.demands
        else [*numbers, ("demands met", f"{sum(one.met for one in found.demands)} of {len(found.demands)}", "")]
    )


def _plotted(found: Acceptance) -> tuple[str, str]:
    without = [symbol for symbol in found.worst_values if found.decision_of(symbol) is None]
    named = f" Without a limit, and not drawn: {', '.join(without)}." if without else ""
    return "All test values over their limits", f"Bars are ± U, dashed lines the limits; places are in the order of names.{named}"


def _plot(found: Acceptance) -> str:
    """Values over their limits with their uncertainties, quantity by quantity."""
    figure, axes = figures.blank(8.0, 3.0)
    at, ticks = 0.0, []
    for symbol in found.worst_values:
        own = [one for one in found.values if one.symbol == symbol and one.limit_mm is not None]
        for one in own:
            assert one.limit_mm is not None
            value, expanded = one.budget.value_mm / one.limit_mm, one.budget.expanded_mm / one.limit_mm
            axes.errorbar(at, value, expanded, fmt="o", color=COLOURS[one.decision], markersize=3.2, linewidth=1.2, capsize=1.5)
            at += 1
        ticks += [(at - 0.5 - len(own) / 2, symbol)] if own else []
        at += 2 if own else 0
    for limit in (-1, 1):
        axes.axhline(limit, color=figures.TEXT, linewidth=1.0, linestyle="--")
    axes.axhline(0, color=figures.TEXT, linewidth=0.5)
    axes.set(ylabel="error / limit", xlim=(-1.5, max(at - 1.5, 1)))
    axes.set_xticks([place for place, _ in ticks], [symbol for _, symbol in ticks])
    axes.tick_params(axis="x", length=0)
    return figures.inline_svg(figure)


_MAP = (
    "Middles of the artefacts in the volume",
    "Left as camera 1 sees them, right from above; the box is the volume. Circles are spheres, squares bars, crosses planes.",
)


def _map(found: Acceptance, subject: Subject) -> str:
    """Middles of the artefacts, from the front and from above."""
    figure, front = figures.blank(8.0, 2.8)
    front.remove()
    volume = subject.artefacts.volume
    for number, (first, second) in enumerate(((0, 1), (0, 2))):
        axes = figure.add_subplot(1, 2, number + 1)
        low = np.array(volume.centre_mm) - np.array(volume.size_mm) / 2
        high = low + volume.size_mm
        sides = [low[first], high[first], high[first], low[first], low[first]]
        axes.plot(sides, [low[second]] * 2 + [high[second]] * 2 + [low[second]], color=figures.TEXT, linewidth=1.0)
        for kind, mark in (("sphere", "o"), ("bar", "s"), ("plane", "x")):
            if kind in found.middles:
                axes.plot(*found.middles[kind][:, [first, second]].T, mark, color=figures.BARS, markersize=5, fillstyle="none")
        axes.set(aspect="equal", xlabel="x, mm", ylabel=("y, mm", "z, mm")[number])
        axes.invert_yaxis() if number == 0 else None
        axes.tick_params(colors=figures.TEXT)
        for words in (axes.xaxis.label, axes.yaxis.label):
            words.set_color(figures.TEXT)
        for spine in axes.spines.values():
            spine.set_visible(False)
    return figures.inline_svg(figure)


def _budgets(found: Acceptance) -> list[str]:
    """A table a quantity, of the place that decides."""
    blocks = [page.paragraph("Of each quantity the place that decides; all others stand in certificate.json.")]
    for symbol, one in found.worst_values.items():
        blocks += [page.paragraph(f"{symbol} at {one.place}: {CHARACTERISTICS[symbol].title}.")]
        blocks += [page.table(BUDGET_HEAD, budget_rows(one.budget), budget_summary(one))]
    return blocks
