"""`sonotwin accuracy`: what it writes, its exit status, and what it refuses before it measures."""

import json

import pytest

from sonotwin.cli import main
from twin.accuracy import optics_accuracy
from twin.accuracy.table_rows import Row


@pytest.fixture
def quick(monkeypatch):
    """The optics group with one row, whose figure the test chooses."""

    def measure(value: float) -> None:
        monkeypatch.setattr(
            optics_accuracy, "measurements", lambda setup: [lambda: [Row("a", "an error", value, 0.05, None, "mm")]]
        )

    return measure


@pytest.mark.parametrize(("value", "status"), [(0.01, 0), (0.09, 1)])
def test_rows_are_written_and_missed_bars_told(quick, value, status, tmp_path, capsys):
    """JSON and table hold the figure either way; the exit status says whether the bar was met."""
    quick(value)
    page = tmp_path / "page.md"
    page.write_text("<!-- optics -->\n<!-- /optics -->\n")
    assert main(["accuracy", "only=optics", f"out={tmp_path / 'out'}", f"document={page}"]) == status
    (record,) = json.loads((tmp_path / "out" / "optics.json").read_text())
    assert (record["measured"], record["ok"]) == (value, status == 0)
    assert f"| {value} |" in page.read_text()
    assert ("MISS" in capsys.readouterr().out) == (status == 1)


@pytest.mark.parametrize(
    ("field", "complaint"),
    [
        ("document=none.md", "none.md: expected a Markdown file, found none"),
        ("real=nowhere", "accuracy: real: expected a folder of recordings, found none at nowhere"),
        (
            "only=acoustics",
            "accuracy: only: expected 'optics', 'surface', 'reality', 'calibration', 'scale', 'lifelike', 'ultrasound', "
            "'tracking', 'session', 'studies', 'strangers', 'trust' or 'live', found 'acoustics'",
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
