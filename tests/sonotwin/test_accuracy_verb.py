"""`sonotwin accuracy`: what it writes, its exit status, and what it refuses before it measures."""

from pathlib import Path

import pytest

from sonotwin.cli import main
from twin.experiments import bars, result_rows
from twin.experiments.bars import Experiment, Figure
from twin.experiments.result_rows import Row

ROOT = Path(__file__).resolve().parents[2]


def measured(setup, value: float) -> dict[str, float]:
    """An experiment that gives what it is given."""
    return {"error_mm": value}


@pytest.fixture
def quick(monkeypatch):
    """The optics group with one row, whose figure the test chooses."""

    def measure(value: float) -> None:
        figure = Figure(figure="error_mm", what="an error", most=0.05, unit="mm")
        one = Experiment("optics", f"{__name__}.measured", "", {"value": value}, {}, None, (figure,))
        monkeypatch.setattr(bars, "read", lambda path: [one])

    return measure


@pytest.mark.parametrize(("value", "status"), [(0.01, 0), (0.09, 1)])
def test_rows_are_written_and_missed_bars_told(quick, value, status, tmp_path, capsys):
    """Parquet, file of rows and table hold the figure; rows of other groups stay; the status says whether the bar was met."""
    quick(value)
    page = tmp_path / "page.md"
    page.write_text("<!-- rows -->\n<!-- /rows -->\n")
    others = result_rows.read(ROOT / "docs" / "accuracy.csv")
    result_rows.write(page.with_suffix(".csv"), others)
    assert main(["accuracy", "only=optics", f"out={tmp_path / 'out'}", f"document={page}"]) == status
    (row,) = result_rows.read_table(tmp_path / "out" / "results.parquet")
    assert (row.measured, row.met, row.settings) == (value, status == 0, f'{{"value": {value}}}')
    first, *rest = result_rows.read(page.with_suffix(".csv"))
    assert (first.measured, first.met, first.what) == (value, status == 0, "an error")
    assert str(rest) == str([row for row in others if row.group != "optics"])
    assert (f"| an error | optics | {value} mm | <= 0.05 |  |  | **no** |" in page.read_text()) == (status == 1)
    assert ("MISS" in capsys.readouterr().out) == (status == 1)


def test_rows_of_recordings_stay_without_them(monkeypatch, tmp_path, capsys):
    """With a line that says what is left out and why; a row that the entry no longer gives goes."""
    shown, real = (
        Figure(figure="error_mm", what=what, unit="mm") for what in ("{about}: shown", "recorded, {width:g} px: {name}")
    )
    ours = Experiment("optics", f"{__name__}.measured", "ours", {"value": 0.01}, {}, None, (shown,))
    recorded = Experiment("optics", "a.b", "", {}, {"name": "off"}, "real", (real,))
    monkeypatch.setattr(bars, "read", lambda path: [ours, recorded])
    page = tmp_path / "page.md"
    page.write_text("<!-- rows -->\n<!-- /rows -->\n")
    old = [
        Row("optics", what, 3.0, "", None, None, "mm", None)
        for what in ("recorded, 640 px: off", "recorded: none", "ours: shown")
    ]
    result_rows.write(page.with_suffix(".csv"), old)
    assert main(["accuracy", "only=optics", f"out={tmp_path / 'out'}", f"document={page}"]) == 0
    rows = result_rows.read(page.with_suffix(".csv"))
    assert [(row.what, row.measured) for row in rows] == [("recorded, 640 px: off", 3.0), ("ours: shown", 0.01)]
    assert "left out a.b: it needs recordings, as real=FOLDER; rows of earlier runs stay" in capsys.readouterr().out


def test_a_broken_file_of_rows_is_refused_first(quick, tmp_path, capsys):
    """It would be replaced else, and its figures lost."""
    quick(0.01)
    page = tmp_path / "page.md"
    page.write_text("<!-- rows -->\n<!-- /rows -->\n")
    page.with_suffix(".csv").write_text("a,b\n1,2\n")
    assert main(["accuracy", "only=optics", f"out={tmp_path / 'out'}", f"document={page}"]) == 2
    assert "page.csv: line 1: expected group,what" in capsys.readouterr().err
    assert page.with_suffix(".csv").read_text() == "a,b\n1,2\n" and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("field", "complaint"),
    [
        ("document=none.md", "none.md: expected a Markdown file, found none"),
        ("real=nowhere", "accuracy: real: expected a folder of recordings, found none at nowhere"),
        (
            "only=acoustics",
            "accuracy: only: expected 'optics', 'surface', 'reality', 'calibration', 'scale', 'lifelike', 'ultrasound', "
            "'tracking', 'session', 'studies', 'strangers', 'trust', 'live', 'drift' or 'bodies', found 'acoustics'",
        ),
    ],
)
def test_mistakes_are_said_first(quick, field, complaint, tmp_path, monkeypatch, capsys):
    """One line, exit status 2, nothing written."""
    quick(0.01)
    monkeypatch.chdir(tmp_path)
    assert main(["accuracy", "only=optics", field]) == 2
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / "outputs").exists()
