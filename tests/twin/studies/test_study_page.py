"""A study's page has its figures, its table and its commands, and is complete."""

import re
from html import unescape
from html.parser import HTMLParser

import numpy as np
import pytest

from tests.twin.studies.made_up import done
from twin.experiments.experiment_runs import Experiment
from twin.studies import budget_page, error_budget, rig_search, search_page, study_page, study_plots
from twin.studies.error_budget import Budget, Contribution, Sum
from twin.studies.rig_search import Bound, Candidate, Goal

LIMITS = {"error_mm": "limit_mm", "turn_deg": ""}
OF = Experiment((), lambda settings, seed: {}, LIMITS, "noise alone")
DONE = [
    done({"rig.pitch": pitch, "light": light}, {"error_mm": pitch * (1 + seed), "limit_mm": pitch / 4, "turn_deg": 0.5}, seed)
    for pitch in (6, 12)
    for light in ("dim", "<bright>")
    for seed in (0, 1, 2)
]


class Balance(HTMLParser):
    """Elements that are open, and the sources that are fetched."""

    EMPTY = frozenset({"img", "meta", "link", "br", "hr", "input", "path", "use", "rect"})

    def __init__(self):
        super().__init__()
        self.open, self.fetched = [], []

    def handle_starttag(self, tag, attributes):
        self.fetched += [value for name, value in attributes if name in ("src", "href") and not value.startswith(("data:", "#"))]
        if tag not in self.EMPTY:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in self.EMPTY:
            self.open.pop()

    def handle_endtag(self, tag):
        if tag not in self.EMPTY:
            assert self.open.pop() == tag


def written(folder, trials, sections) -> str:
    study_page.write(folder, "Pitch & light", trials, sections, ["sonotwin study name=sweep 'over={a: [1, 2]}'"])
    return (folder / study_page.PAGE).read_text(encoding="utf-8")


def shown(folder, trials, of=OF, names=study_page.NO_NAMES):
    return [*study_page.plots(folder, trials, of, names), study_page.points(trials, of, names)]


def text(html: str) -> str:
    return unescape(re.sub(r"<svg.*?</svg>", " ", html, flags=re.S))


def rows_of(html: str) -> list[list[str]]:
    """Cells of the page's tables."""
    rows = re.findall(r"<tr>(.*?)</tr>", html, flags=re.S)
    return [[unescape(re.sub("<.*?>", "", cell)) for cell in re.findall(r"<t[hd].*?</t[hd]>", row, flags=re.S)] for row in rows]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A study's folder with its page and plots."""
    made = tmp_path_factory.mktemp("study")
    written(made, DONE, shown(made, DONE))
    return made


@pytest.fixture
def page(folder) -> str:
    return (folder / study_page.PAGE).read_text(encoding="utf-8")


def test_a_page_is_complete(folder, page):
    """Elements are closed, nothing is fetched, commands and titles are there, and words of people are no HTML."""
    balance = Balance()
    balance.feed(page)
    assert not balance.open and not balance.fetched
    assert "<bright>" not in page
    for part in (
        "Pitch & light",
        "12 of 12 trials gave figures.",
        "sonotwin study name=sweep 'over={a: [1, 2]}'",
        f"pandas.read_parquet('{folder / 'table.parquet'}')",
        "<h2>Error, mm</h2>",
        "<h2>Turn, deg</h2>",
    ):
        assert part in text(page)
    assert "Points without figures" not in page


def test_each_figure_is_drawn_over_each_factor_and_kept(folder, page):
    names = {f"{figure}_over_{field}.png" for figure in LIMITS for field in ("rig_pitch", "light")}
    assert {path.name for path in (folder / "figures").iterdir()} == names
    assert all((folder / "figures" / name).read_bytes().startswith(b"\x89PNG") and f"figures/{name}" in page for name in names)
    assert page.count("<svg") == 4


def test_the_table_has_medians_a_point(page):
    """Over seeds; in brackets what they are held against, which plots and the caption name."""
    head, *rows = rows_of(page)
    assert head == ["pitch", "light", "trials", "error, mm", "turn, deg"]
    assert rows[:2] == [["6", "dim", "3", "12 (1.5)", "0.5"], ["6", "<bright>", "3", "12 (1.5)", "0.5"]] and len(rows) == 4
    assert "Medians over seeds; in brackets: noise alone." in text(page) and "closed form" not in page


def test_counts_are_added_up_over_seeds(tmp_path):
    """A miss in one of four trials is a miss, which no median shows; a trial without figures counts nothing."""
    of = Experiment((), lambda settings, seed: {}, {"error_mm": ""}, counts=("masses_missed", "masses_false"))
    counted = [{"masses_missed": float(seed == 2), "masses_false": 2.0, "error_mm": 0.1 * seed} for seed in range(4)]
    trials = [done({"light": "dim"}, figures, seed) for seed, figures in enumerate(counted)] + [done({"light": "dim"}, "dark", 4)]
    page = written(tmp_path, trials, [study_page.points(trials, of, study_page.NO_NAMES)])
    assert rows_of(page)[-2] == ["light", "trials", "masses missed", "masses false", "error, mm"]
    assert rows_of(page)[-1] == ["dim", "5", "1", "8", "0.15"]
    assert "Sums over seeds of masses missed to masses false. Medians over seeds of all else." in text(page)


def test_points_without_figures_are_named(tmp_path):
    trials = [*DONE, done({"rig.pitch": 40, "light": "dim"}, "coverage: found none", 7)]
    page = text(written(tmp_path, trials, [study_page.points(trials, OF, study_page.NO_NAMES)]))
    assert "12 of 13 trials gave figures." in page and "rig.pitch=40, light=dim, seed=7: coverage: found none" in page
    assert rows_of(page)[-1][:3] == ["40", "dim", "1"]


def test_a_trial_is_named_by_what_varies(tmp_path):
    """Of twenty fields those with several values; a point that is alone by all, or by a label that it is given."""
    same = {f"noise.drawn.{k}": 0.0 for k in range(20)}
    trials = [done(same | {"rig.pitch": pitch}, "nothing seen", seed) for pitch in (6, 9) for seed in (0, 1)]
    assert study_page.labels(trials) == ["rig.pitch=6", "rig.pitch=6", "rig.pitch=9", "rig.pitch=9"]
    assert study_page.named(trials[1], "rig.pitch=6") == "rig.pitch=6, seed=1" and study_page.named(trials[1], "") == "seed=1"
    assert study_page.labels([done({"a": 20000}, {}), done({"a": 20000}, {}, 1)]) == ["a=20000", "a=20000"]
    study_page.write(tmp_path, "Budget", trials, [], [], ["all sources", "all sources", "bow alone", "bow alone"])
    assert "<li>bow alone, seed=1: nothing seen</li>" in (tmp_path / study_page.PAGE).read_text(encoding="utf-8")


@pytest.mark.parametrize("longest", [0.013, 0.52, 0.98, 1.0, 37.0])
def test_an_axis_of_squares_has_a_few_round_lengths(longest):
    """From zero, with room between them."""
    lengths = budget_page.lengths(longest)
    assert lengths[0] == 0 and 4 <= len(lengths) <= 9 and lengths[-1] > 0.8 * longest
    assert (np.diff(np.square(lengths)) >= 0.07 * longest**2).all()


def test_a_study_without_factors_has_a_table_alone(tmp_path):
    trials = [done({}, {"error_mm": 2.0, "limit_mm": 1.0, "turn_deg": 3.0}, seed) for seed in range(3)]
    page = written(tmp_path, trials, shown(tmp_path, trials))
    assert rows_of(page)[1] == ["3", "2 (1)", "3"] and "<svg" not in page


def candidates() -> list[Candidate]:
    values = [(5.0, 0.1), (2.0, 0.5), (3.0, -0.1), (float("nan"), -1.0), (4.0, -0.2)]
    return [Candidate({"a.pitch": k}, (), value, {"time_s": 1 + excess}, excess) for k, (value, excess) in enumerate(values)]


def test_a_search_shows_its_course_and_the_best_within_bounds(tmp_path):
    """The best first; what is out of bounds is no best, however small."""
    goal = Goal(least="error_mm", bounds={"time_s": Bound(most=1.0)})
    (section,) = search_page.sections(tmp_path, goal, candidates())
    head, *rows = rows_of("".join(section.blocks))
    assert head == ["pitch", "error, mm", "time, s, in the worst"] and rows == [["2", "3", "0.9"], ["4", "4", "0.8"]]
    assert (tmp_path / "figures" / "search.png").is_file()
    (axes,) = search_page.course(goal, candidates()).axes
    lines = {line.get_label(): line for line in axes.get_lines()}
    assert lines["within all bounds"].get_xydata().tolist() == [[3, 3], [5, 4]]
    assert lines["out of bounds: time, s"].get_xdata().tolist() == [1, 2]
    assert (lines["no figures"].get_xdata().tolist(), lines["no figures"].get_ydata().tolist()) == ([4], [1])  # the upper edge
    assert all(tick == round(tick) for tick in axes.get_xticks())
    assert lines["best so far"].get_ydata().tolist()[2:] == [3, 3, 3]


def test_a_search_in_vain_says_so(tmp_path):
    goal = Goal(least="error_mm", bounds={"time_s": Bound(most=1.0)})
    (section,) = search_page.sections(tmp_path, goal, candidates()[:2])
    assert rig_search.best(candidates()[:2]) is None and "No candidate kept all bounds." in section.blocks[0]


def test_each_bound_that_is_missed_has_a_cross_of_its_own():
    """By the one that is missed most; a bound that nobody missed isn't in the legend."""
    goal = Goal(least="error_mm", bounds={"time_s": Bound(most=1.0), "coverage": Bound(least=0.9), "price": Bound(most=9)})
    bounds = [{"time_s": 1.1, "coverage": 0.3}, {"time_s": 3.0, "coverage": 0.8}, {"time_s": 1.0, "coverage": float("nan")}]
    excess = [0.7, 2.0, float("inf")]
    tried = [Candidate({"a": 1}, (), 1.0, bound | {"price": 1}, over) for bound, over in zip(bounds, excess, strict=True)]
    (axes,) = search_page.course(goal, tried).axes
    lines = {line.get_label(): line for line in axes.get_lines()}
    crosses = {label: line for label, line in lines.items() if label.startswith("out of bounds")}
    assert {label: line.get_xdata().tolist() for label, line in crosses.items()} == {
        "out of bounds: coverage": [1, 3],
        "out of bounds: time, s": [2],
    }
    assert len({line.get_marker() for line in crosses.values()}) == 2


def test_a_start_without_figures_is_explained(tmp_path):
    """By its reason, and nothing is said of an improvement."""
    point = {"a.pitch": 40}
    start = Candidate(
        point,
        (done(point, {"error_mm": 1.0}), done(point, "coverage: found none")),
        float("nan"),
        {"time_s": float("nan")},
        float("inf"),
    )
    goal = Goal(least="error_mm", start=point, bounds={"time_s": Bound(most=1.0)})
    (section,) = search_page.sections(tmp_path, goal, [start, *candidates()])
    assert "no improvement on it can be stated: coverage: found none" in section.blocks[0]
    assert not any("no improvement" in block for block in search_page.sections(tmp_path, goal, candidates())[0].blocks)
    incomplete = Candidate(point, (done(point, {"error_mm": float("nan")}),), float("nan"), {}, 0.0)
    assert incomplete.lost == "the figure is missing in a trial" and not candidates()[0].lost


def test_figures_have_the_studys_names(tmp_path):
    """And an error of both signs is shown by its size, where it stands beside one."""
    names = {"error_mm": study_plots.Name("CR1, mean of five points, ours, mm", (0.6, 0.6))}
    trials = [
        done({"light": light}, {"error_mm": error, "limit_mm": 1.5, "turn_deg": -2.0})
        for light, error in (("a", -3.0), ("b", 2.0))
    ]
    page = text(written(tmp_path, trials, shown(tmp_path, trials, names=names)))
    assert "<h2>CR1, mean of five points, ours, mm</h2>" in page
    head, first, second = rows_of(page)
    assert head == ["light", "trials", "size of CR1, mean of five points, ours, mm", "turn, deg"]
    assert (first[2:], second[2:]) == (["3 (1.5)", "-2"], ["2 (1.5)", "-2"])


BUDGET = Budget(sources={"bow": ("b",), "print": ("p",), "dust": ("d",)}, figures={"error_mm": "a place"})
SUM = Sum(
    "error_mm",
    0.52,
    24,
    (Contribution("bow", 0.4, 0.8, 24), Contribution("print", 0.3, 0.6, 24), Contribution("dust", 0.0, 0.0, 24)),
    {"bow + print": (0.45, 0.5)},
)


def test_a_waterfall_adds_squares_up_to_the_sum():
    """Each bar begins where the one before ends; a source of nothing gets none of its own."""
    (axes,) = budget_page.waterfall(SUM).axes
    bars = [(bar.get_x(), bar.get_width()) for bar in axes.patches]
    assert bars[:2] == [(0, pytest.approx(0.16)), (pytest.approx(0.16), pytest.approx(0.09))]
    ticks = dict(zip((label.get_text() for label in axes.get_xticklabels()), axes.get_xticks(), strict=True))
    assert len(ticks) > 3 and all(place == pytest.approx(float(length) ** 2) for length, place in ticks.items())
    (error,) = axes.collections
    (ends,) = error.get_segments()
    assert ends[:, 0] == pytest.approx([(0.52 * (1 - 48**-0.5)) ** 2, (0.52 * (1 + 48**-0.5)) ** 2])
    assert axes.get_xlim()[1] > ends[1, 0] and "mm²" not in axes.get_xlabel()
    assert bars[2][1] == pytest.approx(0, abs=1e-9) and bars[3][1] == pytest.approx(0.25) and bars[4][1] == pytest.approx(0.52**2)
    names = ["bow", "print", "all others", "sum in squares", "all together, ± 1 sigma"]
    assert [label.get_text() for label in axes.get_yticklabels()] == names


def test_a_budgets_section_has_its_parts_its_advice_and_its_prediction(tmp_path):
    (section,) = budget_page.sections(tmp_path, BUDGET, [SUM])
    html = "".join(section.blocks)
    rows = rows_of(html)
    assert section.title == "A place" and (tmp_path / "figures" / "budget_error_mm.png").is_file()
    assert rows[0] == ["source", "alone, mm", "± 1 sigma", "2 times as large, mm", "share of the square, %"]
    assert rows[1:4] == [
        ["bow", "0.4000", "0.0577", "0.8000", "64.0"],
        ["print", "0.3000", "0.0433", "0.6000", "36.0"],
        ["dust", "0.0000", "0.0000", "0.0000", "0.0"],
    ]
    assert rows[5] == ["bow + print", "0.4500", "0.5000", "0.90"]
    assert error_budget.advice(BUDGET, SUM)[0] in unescape(html) and error_budget.explained(SUM) in unescape(html)
