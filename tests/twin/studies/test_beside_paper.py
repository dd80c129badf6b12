"""Figures of the paper stand beside those of its method in the twin and of ours, by trials whose figures are given."""

import math

import pytest

from tests.twin.studies.made_up import done
from twin.studies import beside_paper
from twin.studies.beside_paper import FACTOR, Figure

PLANES = Figure(what="planes, RMS", reported=(0.1, 0.13), paper="paper_mm", ours="ours_mm", limit="limit_mm", bar=0.06, unit="mm")
KNOWN = Figure(what="planes, RMS", ours="ours_mm", predicted="limit_mm", unit="mm")
RADIUS = Figure(what="radius error", reported=(0.045, 0.045), ours="radius_mm", unit="mm")


def trial(conditions: str, seed: int, paper: float, ours: float, radius: float = -0.01, limit: float = 0.02):
    figures = {"paper_mm": paper, "ours_mm": ours, "radius_mm": radius, "limit_mm": limit}
    return done({"conditions": conditions}, figures, seed)


DONE = [
    trial("ideal", 0, 0.11, 0.03, -0.01),
    trial("lifelike", 0, 0.30, 0.04, 0.02),
    trial("ideal", 1, 0.13, 0.05, 0.03, 0.04),
    trial("lifelike", 1, 0.20, 0.07, -0.04),
]


def test_each_figure_stands_under_each_point():
    """In the order of both; signs of errors don't count."""
    found = beside_paper.compare([PLANES, RADIUS], DONE)
    assert [(one.point, one.figure.what) for one in found] == [
        ("ideal", "planes, RMS"), ("lifelike", "planes, RMS"), ("ideal", "radius error"), ("lifelike", "radius error")
    ]  # fmt: skip
    assert (found[0].paper.tolist(), found[0].ours.tolist()) == ([0.11, 0.13], [0.03, 0.05])
    assert found[0].limit == pytest.approx(0.03) and math.isnan(found[2].limit)
    assert found[3].ours.tolist() == [0.02, 0.04] and found[3].paper.size == 0


def test_cells_have_means_and_in_brackets_the_range_and_the_trials():
    planes, _, radius, _ = map(beside_paper.cells, beside_paper.compare([PLANES, RADIUS], DONE))
    assert planes == [
        "ideal", "planes, RMS", "0.1 to 0.13", "0.120 (0.110–0.130; 2)", "yes", "0.040 (0.030–0.050; 2)", "0.03", "", "mm"
    ]  # fmt: skip
    assert radius == ["ideal", "radius error", "0.045", "", "no", "0.020 (0.010–0.030; 2)", "", "", "mm"]
    assert len(planes) == len(beside_paper.HEAD)


def test_a_prediction_is_no_limit():
    """What covariances predict stands in a column of its own, as ours may come out below it."""
    (found, _) = beside_paper.compare([KNOWN], DONE)
    row = dict(zip(beside_paper.HEAD, beside_paper.cells(found), strict=True))
    assert (row["limit of noise"], row["predicted for ours"]) == ("", "0.03") and math.isnan(found.limit)


def test_what_was_fitted_is_not_met():
    """It shows what the paper reports, and that meeting it says nothing."""
    (found, _) = beside_paper.compare([PLANES.model_copy(update={"fitted": True})], DONE)
    assert found.paper_met is None and beside_paper.cells(found)[2:5:2] == ["0.1 to 0.13", "fitted"]


def test_figures_have_names_for_plots():
    """Whose method's they are, their unit, and what the paper reports."""
    names = beside_paper.names([PLANES, KNOWN.model_copy(update={"ours": "count", "unit": ""})])
    assert {name: found.title for name, found in names.items()} == {
        "ours_mm": "planes, RMS, ours, mm",
        "paper_mm": "planes, RMS, paper's method, mm",
        "count": "planes, RMS, ours",
    }
    assert names["ours_mm"].reported == (0.1, 0.13) and names["count"].reported is None


def test_meanings_are_given_once():
    same = [figure.model_copy(update={"meaning": "RMS: root mean square."}) for figure in (PLANES, RADIUS)]
    assert beside_paper.meanings([*same, KNOWN]) == ["RMS: root mean square."]


def test_a_missing_figure_misses_its_bar():
    """Whichever way the bar is; the worst of a bar from below is the least."""
    lost = [*DONE[:1], done({"conditions": "ideal"}, {"paper_mm": 0.1, "ours_mm": math.nan}, 2)]
    (whole,), (some,) = (beside_paper.compare([PLANES], each) for each in (DONE[:1], lost))
    assert whole.bar_met and not some.bar_met and some.missing == 1 and math.isnan(some.worst)
    count = Figure(what="inside", reported=(3, 3), paper="paper", ours="ours", bar=3, at_least=True, factor=1, unit="")
    trials = [done({}, {"paper": paper, "ours": 3}, seed) for seed, paper in enumerate((3, 2))]
    (kept,), (fewer,) = (beside_paper.compare([count], each) for each in (trials[:1], [*trials, done({}, {"ours": 2}, 2)]))
    assert kept.bar_met and kept.paper_met and not fewer.bar_met and fewer.worst == 2 and not fewer.paper_met


def test_a_figure_that_the_paper_lacks_is_neither_met_nor_missed():
    (only,) = beside_paper.compare([Figure(what="volumes", paper="paper_mm", ours="ours_mm", unit="mm")], DONE[:1])
    assert only.paper_met is None
    assert beside_paper.cells(only)[2:6] == ["none", "0.110 (0.110–0.110; 1)", "", "0.030 (0.030–0.030; 1)"]


def test_a_table_in_markdown_has_a_row_a_figure_and_point():
    compared = beside_paper.compare([PLANES, RADIUS, KNOWN], DONE)
    head, line, *rows = beside_paper.markdown(compared).split("\n")
    assert [cell.strip() for cell in head.strip("|").split("|")] == list(beside_paper.HEAD) and set(line) == {"|", "-"}
    assert [[cell.strip() for cell in row[1:-1].split("|")] for row in rows] == [beside_paper.cells(one) for one in compared]
    assert len({row.count("|") for row in (head, line, *rows)}) == 1
    alone = beside_paper.markdown(beside_paper.compare([RADIUS], DONE)).split("\n")
    assert "limit" not in alone[0] and "predicted" not in alone[0] and {row.count("|") for row in alone} == {8}


def test_of_many_points_the_table_has_a_column_each():
    """With the means; a method without a figure there is unknown."""
    more = [*DONE, trial("lifelike.board", 0, 0.4, 0.02), trial("lifelike.board", 1, 0.2, 0.01)]
    lines = beside_paper.markdown(beside_paper.compare([PLANES, RADIUS], more)).splitlines()
    assert [[cell.strip() for cell in line[1:-1].split("|")] for line in lines if "---" not in line] == [
        ["figure", "by", "paper reported", "ideal", "lifelike", "lifelike.board", "unit"],
        ["planes, RMS", "paper's method", "0.1 to 0.13", "0.120", "0.250", "0.300", "mm"],
        ["planes, RMS", "ours", "", "0.040", "0.055", "0.015", "mm"],
        ["radius error", "paper's method", "0.045", "unknown", "unknown", "unknown", "mm"],
        ["radius error", "ours", "", "0.020", "0.030", "0.010", "mm"],
    ]


@pytest.mark.parametrize(
    ("sizes", "explained"),
    [
        ((0.1, 0.13), True),
        ((0.1 / FACTOR + 0.001, 0.1 / FACTOR + 0.001), True),
        ((0.1 / FACTOR - 0.001, 0.1 / FACTOR - 0.001), False),
        ((0.13 * FACTOR - 0.001, 0.13 * FACTOR - 0.001), True),
        ((0.13 * FACTOR + 0.001, 0.13 * FACTOR + 0.001), False),
        ((0.01, 0.21), True),
        ((math.nan, 0.11), True),
        ((math.nan, math.nan), False),
    ],
)
def test_the_papers_method_explains_what_is_within_a_factor(sizes, explained):
    """By its mean, of the trials that measured; none explains nothing."""
    (found,) = beside_paper.compare([PLANES], [trial("ideal", seed, size, 0.01) for seed, size in enumerate(sizes)])
    assert found.paper_met == explained and beside_paper.cells(found)[4] == ("yes" if explained else "no")


def test_a_bar_is_met_by_the_worst_trial():
    """Whatever the paper's method does; nothing is asked where there is no bar, and without trials a bar isn't met."""
    assert [one.bar_met for one in beside_paper.compare([PLANES, RADIUS], DONE)] == [True, False, True, True]
    (at,) = beside_paper.compare([PLANES], [trial("ideal", 0, 9.0, -0.06)])
    (lost,) = beside_paper.compare([PLANES], [done({"conditions": "ideal"}, "saturated")])
    assert at.bar_met and not lost.bar_met and beside_paper.cells(lost)[3:7] == ["", "no", "", "unknown"]
    (asked_nothing,) = beside_paper.compare([RADIUS], [done({"conditions": "ideal"}, "saturated")])
    assert asked_nothing.bar_met
