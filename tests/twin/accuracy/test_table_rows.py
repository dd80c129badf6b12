"""Rows: bars in both directions, the JSON's keys, the table in a document."""

import json

import numpy as np
import pytest

from recon.errors import InputError
from twin.accuracy.table_rows import Row, measure, refresh, table, write

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
    assert text.startswith("before\n<!-- one -->\n\n| id |")
    assert text.endswith("<!-- /one -->\nbetween\n<!-- two -->\n<!-- /two -->\nafter\n")
    assert "old" not in text and text.count("| a | an error | 0.02 | <= 0.05 | 0.01 | mm | yes |") == 1
    with pytest.raises(InputError, match="<!-- three -->"):
        refresh(page, "three", "")
