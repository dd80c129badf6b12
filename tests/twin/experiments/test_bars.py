"""Bars: rows of figures, what is measured once, and that the documents' rows are those of conf/bars."""

import inspect
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from recon.errors import InputError
from recon.files import yaml_text
from recon.files.code_digest import code_digest
from tests.twin.experiments.asked import CONF, FILES, experiments
from twin.conditions import Conditions
from twin.engine import Engine
from twin.experiments import bars, experiment_runs, paper_causes, result_rows, trust_accuracy
from twin.experiments.experiment_setup import Setup
from twin.experiments.kept_figures import Kept, State

BEFORE = "bracket that gives over the wires, over switching"  # a row of before the bracket in the scan was counted, too
CALLS = Counter()


def doubled(setup: Setup, length_mm: float) -> dict[str, float]:
    """An experiment."""
    CALLS[length_mm] += 1
    return {"double_mm": 2 * length_mm, "limit_mm": length_mm} | ({"odd_mm": 1.0} if length_mm == 3 else {})


ENTRIES = f"""
- of: {__name__}.doubled
  about: "{{length_mm:g}} mm"
  over: {{length_mm: [1.0, 3.0]}}
  words: {{most: 5.0}}
  rows:
    - {{figure: double_mm, what: "{{about}}: double", most: most, limit: limit_mm, unit: mm}}
    - {{figure: double_mm, what: "{{about}}, {{name}}: double", least: "1.5 {{of}}", each: {{name: [x], of: [limit_mm]}}}}
    - {{figure: odd_mm, what: "{{about}}: odd", optional: true}}
- {{of: {__name__}.missing, needs: real, rows: []}}
"""


@pytest.fixture
def group(tmp_path) -> list[bars.Experiment]:
    (tmp_path / "group.yaml").write_text(ENTRIES)
    CALLS.clear()
    return bars.read(tmp_path / "group.yaml")


def test_rows_have_words_bars_and_limits(group, rig):
    """Bars in both directions, by numbers and by figures; a figure that isn't there is left out where that is allowed."""
    rows = list(bars.measure(group, Setup(rig), None, Engine()))
    assert [(row.what, row.measured, row.sense, row.bar, row.limit, row.met) for row in rows] == [
        ("1 mm: double", 2.0, "<=", 5.0, 1.0, True),
        ("1 mm, x: double", 2.0, ">=", 1.5, None, True),
        ("3 mm: double", 6.0, "<=", 5.0, 3.0, False),
        ("3 mm, x: double", 6.0, ">=", 4.5, None, True),
        ("3 mm: odd", 1.0, "", None, None, None),
    ]
    assert (rows[0].group, rows[0].figure, rows[0].settings) == ("group", "double_mm", '{"length_mm": 1.0}')


def test_no_number_meets_no_bar(group):
    (row, *_) = group[0].rows({"double_mm": float("nan"), "limit_mm": 1.0})
    assert row.met is False


def test_a_figure_that_is_missing_is_an_error(group):
    """One line with file, entry and row, however many hours after the start."""
    with pytest.raises(InputError, match=r"group.yaml: entry 1: double_mm: .* which are double_mm; found 'limit_mm'"):
        group[0].rows({"double_mm": 1.0})


def test_a_figure_isnt_compared_with_a_setting_of_its_name(group):
    """Unless they are the same; the second row's limit is `limit_mm`."""
    figures = {"double_mm": 2.0, "limit_mm": 1.0}
    named = [replace(group[0], words={"most": 5.0, "limit_mm": value}) for value in (1.0, 9.0)]
    assert named[0].rows(figures)[0].limit == 1.0
    with pytest.raises(InputError, match=r"double_mm: limit_mm: expected one value, found 9\.0 of the entry and 1.0 measured"):
        named[1].rows(figures)


def test_a_new_figure_without_a_row_is_refused(group):
    """Where `every` asks for it; those in a text or a bar count."""
    figures = {"double_mm": 2.0, "limit_mm": 1.0, "new: mm": 1.0, "new": 1.0}
    assert group[0].rows(figures) and replace(group[0], every="*_mm").rows(figures)
    with pytest.raises(
        InputError, match=r"group.yaml: entry 1: expected a row for each figure like \*: \*, found none for new: mm;"
    ):
        replace(group[0], every="*: *").rows(figures)


def test_settings_that_are_listed_are_all_that_there_are():
    """Of boards, causes and studies: what is new gets a row, or fails here."""
    life = Conditions.model_validate(yaml_text.read(CONF / "conditions" / "lifelike.yaml"))
    assert listed("trust", "printed_board", "board") == set(trust_accuracy.BOARDS)
    assert listed("lifelike", "one_cause", "cause") == set(paper_causes.causes(life))
    of_boards = set(type(life.board).model_fields) - {"diameter_mm"}  # which moves no centre
    assert listed("lifelike", "shares", "cause") == of_boards | {"flat, exact board", "all of them"}
    beside = {path.stem for path in (CONF / "study").glob("*.yaml") if "beside" in yaml_text.read(path)}
    assert listed("studies", "laboratories", "study") == beside - {"ultrasound_causes"}  # a cause at a time


def listed(group: str, name: str, setting: str) -> set[str]:
    """Values of a setting that an experiment is measured with."""
    found = experiments(CONF / "bars" / "accuracy" / f"{group}.yaml")
    return {one.settings[setting] for one in found if one.of.endswith(f".{name}")}


def test_figures_are_kept_by_code_settings_and_inputs(group, rig, tmp_path, monkeypatch):
    """Measured once; anew for another rig; those that aren't of the twin's own code are measured each time."""
    kept, setup = Kept(tmp_path / "kept"), Setup(rig)
    kept.open()
    first, again = (list(bars.measure(group, setup, kept, Engine())) for _ in range(2))
    assert first == again and CALLS == {1.0: 2, 3.0: 2}
    monkeypatch.setattr(bars, "OURS", __name__.partition(".")[0])
    CALLS.clear()
    other = rig.model_copy(update={"target": rig.target.model_copy(update={"c1_mm": 30.0})})
    for each in (setup, setup, Setup(other)):
        assert list(bars.measure(group, each, kept, Engine())) == first
    assert CALLS == {1.0: 2, 3.0: 2}


def test_what_depends_on_the_moment_is_measured_each_time(group, rig, tmp_path, monkeypatch):
    """Here, alone: after all tasks that were begun; and its rows have the day of this run, kept ones the day they were kept."""
    monkeypatch.setattr(bars, "OURS", __name__.partition(".")[0])
    first, second = (one for one in group if one.needs is None)
    mixed, setup = [replace(first, kept=False), second], Setup(rig)
    for day in ("2026-01-01", "2026-01-02"):
        kept = Kept(tmp_path / "kept", State(day, "abc"))
        kept.open()
        rows = bars.measure(mixed, setup, kept, Engine())
        assert (next(rows).day, CALLS[3.0]) == (day, 1)
        assert {(row.day, row.commit) for row in rows if row.what.startswith("3 mm")} == {("2026-01-01", "abc")}
    assert CALLS == {1.0: 2, 3.0: 1}


def test_a_picture_that_is_missing_is_drawn_again(group, rig, tmp_path, monkeypatch):
    """With its figures, though they were kept."""
    monkeypatch.setattr(bars, "OURS", __name__.partition(".")[0])
    kept, one, out = Kept(tmp_path / "kept"), replace(group[0], draws=("doubled.png",)), tmp_path / "out"
    kept.open()
    out.mkdir()
    for place, calls in ((None, 1), (None, 1), (out, 2), (out, 3)):
        list(bars.measure([one], Setup(rig, out=place), kept, Engine()))
        assert CALLS[1.0] == calls
    (out / "doubled.png").touch()
    list(bars.measure([one], Setup(rig, out=out), kept, Engine()))
    assert CALLS[1.0] == 3


def test_workers_of_other_code_refuse(group, rig, tmp_path):
    """Their figures would be kept under the name of the asker's."""
    kept = Kept(tmp_path / "kept")
    kept.open()
    with pytest.raises(
        InputError, match="engine: expected workers with the code and the libraries of this machine, found others"
    ):
        list(kept.run(Engine(), bars._figures, {"of other code": (group[0], Setup(rig))}))
    assert not CALLS and not list(kept.folder.iterdir())


def test_code_that_is_edited_while_it_measures_is_refused(group, rig, tmp_path, monkeypatch):
    """It is imported late, so nobody can say of which code the figures are; those kept before stay."""
    (code := tmp_path / "code").mkdir()
    monkeypatch.setattr(experiment_runs, "PACKAGES", (code,))
    monkeypatch.setattr(bars, "OURS", __name__.partition(".")[0])
    code_digest(code)
    kept = Kept(tmp_path / "kept")
    kept.open()
    rows = bars.measure(group, Setup(rig), kept, Engine())
    next(rows)
    (code / "late.py").write_text("")
    with pytest.raises(InputError, match=r"engine: expected .* found it edited meanwhile"):
        list(rows)
    assert len(list(kept.folder.iterdir())) == 1 and CALLS == {1.0: 1, 3.0: 1}


@pytest.mark.parametrize(
    ("entry", "complaint"),
    [
        ("{of: a.b, row: []}", "entry 1: rows: "),
        ("{of: a.b, rows: [{what: a}]}", "entry 1: rows.0.figure: "),
        (
            "{of: a.b, rows: [{figure: a, what: a, most: 1, least: 0}]}",
            "entry 1: rows.0: expected one bar, most or least, found most",
        ),
        (
            "{of: a.b, rows: [{figure: a, what: a, each: {b: [1], c: [1, 2]}}]}",
            "entry 1: rows.0.each: expected lists of one length, found 1 b, 2 c",
        ),
    ],
)
def test_a_broken_file_is_refused(entry, complaint, tmp_path):
    (tmp_path / "group.yaml").write_text(f"- {entry}\n")
    with pytest.raises(InputError, match=complaint):
        bars.read(tmp_path / "group.yaml")


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_experiments_take_their_settings(path):
    """Each is there, and has a parameter for each setting and none besides that must be given."""
    for one in experiments(path):
        inspect.signature(one.function).bind(None, **one.settings)


def test_the_documents_rows_are_those_of_the_bars():
    """Each row of docs/accuracy.csv is one of conf/bars, with its words, unit, bar and limit: none is put in by hand."""
    patterns = [
        (path.stem, text, figure)
        for path in FILES
        if path.parent.name == "accuracy"
        for one in experiments(path)
        for figure in one.figures
        for text in figure.texts(one)
    ]
    for row in result_rows.read(CONF.parent / "docs" / "accuracy.csv"):
        fit = [f for group, text, f in patterns if group == row.group and text.fullmatch(row.what)]
        fit = [f for f in fit if ("" if f.most is f.least is None else "<=" if f.least is None else ">=") == row.sense]
        assert len(fit) == 1 or BEFORE in row.what, row
        for figure in fit:
            assert figure.unit in (row.unit, "") or "{" in figure.unit
            for given, found in ((figure.most, row.bar), (figure.least, row.bar), (figure.limit, row.limit)):
                assert not isinstance(given, int | float) or given == pytest.approx(found, rel=1e-3)


def test_all_groups_have_a_file():
    from sonotwin.verbs.accuracy import Group

    assert {path.stem for path in FILES if path.parent.name == "accuracy"} == set(Group.__args__)
    document = Path(CONF.parent / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    assert {path.stem for path in FILES if path.parent.name == "benchmark"} == set(re.findall(r"<!-- (\w+) -->", document))
