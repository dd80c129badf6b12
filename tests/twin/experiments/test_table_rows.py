"""Rows: bars in both directions, the JSON's keys, the table in a document."""

import json
import re
import subprocess

import numpy as np
import pytest

from recon.errors import InputError
from twin.experiments.table_rows import Row, measure, measured_line, refresh, table, write

ROWS = [
    Row("a", "an error", 0.02, 0.05, 0.01, "mm"),
    Row("b", "a share", 0.9, 0.97, None, "", at_least=True),
    Row("c", "nothing", np.nan, 1.0, None, "px"),
]


def test_bars_have_a_direction():
    """An error must stay below its bar, a share reach it, and no number meets none."""
    assert [row.ok for row in ROWS] == [True, False, False]
    assert Row("d", "", 0.97, 0.97, None, "", at_least=True).ok


def test_of_some_nothing_is_asked(tmp_path):
    """They are never missed, and neither table nor JSON names a bar."""
    row = Row("e", "the peer's", 12.0, None, None, "ms")
    write(tmp_path / "group.json", [row])
    assert row.ok and json.loads((tmp_path / "group.json").read_text())[0]["bar"] is None
    assert table([row], "limit").endswith("| e | the peer's | 12 |  |  | ms |  |")


def test_time_is_measured():
    """Rows of one measurement share its time; the rest is kept."""
    (first, second) = measure([lambda: ROWS[:2]])
    assert first.seconds == second.seconds >= 0
    assert (first.id, second.at_least) == ("a", True)


def test_json(tmp_path):
    """A list of records with the agreed keys."""
    write(tmp_path / "deep" / "group.json", ROWS)
    records = json.loads((tmp_path / "deep" / "group.json").read_text())
    assert [list(record) for record in records] == [["id", "what", "measured", "bar", "limit", "unit", "ok", "seconds"]] * 3
    assert [record["ok"] for record in records] == [True, False, False]


def test_a_document_keeps_what_is_around_the_table(tmp_path):
    """Only what stands between the group's marks changes, and again gives the same."""
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- one -->\nold\n<!-- /one -->\nbetween\n<!-- two -->\n<!-- /two -->\nafter\n")
    for _ in range(2):
        refresh(page, "one", table(ROWS, "limit"))
    text = page.read_text()
    assert re.match(r"before\n<!-- one -->\n\nMeasured \d{4}-\d\d-\d\d\.\n\n\| id \|", text) and text.count("Measured") == 1
    assert text.endswith("<!-- /one -->\nbetween\n<!-- two -->\n<!-- /two -->\nafter\n")
    assert "old" not in text and text.count("| a | an error | 0.02 | <= 0.05 | 0.01 | mm | yes |") == 1
    with pytest.raises(InputError, match="<!-- three -->"):
        refresh(page, "three", "")


def test_a_table_names_date_and_commit(tmp_path):
    """The short hash in a repository, marked where a file differs from it; the date alone elsewhere."""

    def git(*arguments):
        return subprocess.run(
            ["git", "-c", "user.name=a", "-c", "user.email=a@b", "-C", str(tmp_path), *arguments],
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()

    assert re.fullmatch(r"Measured \d{4}-\d\d-\d\d\.", measured_line(tmp_path))
    (tmp_path / "code.py").write_text("one\n")
    (tmp_path / "page.md").write_text("one\n")
    git("init", "-q")
    git("add", ".")
    git("commit", "-q", "-m", "one")
    commit = git("rev-parse", "--short=7", "HEAD")
    assert measured_line(tmp_path).endswith(f" at {commit}.")
    (tmp_path / "page.md").write_text("the table of another group\n")
    assert measured_line(tmp_path).endswith(f" at {commit}.")
    (tmp_path / "code.py").write_text("two\n")
    assert measured_line(tmp_path).endswith(f" at {commit}+changes.")
