"""Rows in a file: read as written, replaced a group at a time, shown misses first; and those of the docs."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from recon.errors import InputError
from twin.experiments import result_rows
from twin.experiments.result_rows import Chosen, Row

ROOT = Path(__file__).resolve().parents[3]
DOCUMENT = ROOT / "docs" / "accuracy.md"
CHOICES = ROOT / "conf" / "bars" / "accuracy.yaml"
ROWS = [
    Row("one", 'an error, "quoted" (paper: 0.1 to 0.2)', 0.0123, "<=", 0.05, 0.01, "mm", True, "2026-01-01", "1a2b3c4"),
    Row("one", "a share", 0.9, ">=", 0.97, None, "", False, "2026-01-01", "1a2b3c4"),
    Row("two", "nothing found", math.nan, "<=", 1.0, math.nan, "px", False, "2026-01-02", ""),
    Row("two", "the peer's", 91230.0, "", None, 0.0, "ms", None, "2026-01-02", ""),
]


def test_rows_are_read_as_written(tmp_path):
    """Each cell, with commas, quotes, no bar and no number."""
    path = tmp_path / "rows.csv"
    assert result_rows.read(path) == []
    result_rows.write(path, ROWS)
    assert str(result_rows.read(path)) == str(ROWS)  # two NaN are not equal


def test_a_verdict_is_kept_though_digits_are_not(tmp_path):
    """0.050001 misses a bar of 0.05, and its four digits would not."""
    result_rows.write(tmp_path / "rows.csv", [replace(ROWS[0], measured=0.050001, met=False)])
    assert result_rows.read(tmp_path / "rows.csv")[0].met is False


@pytest.mark.parametrize("line", ["one,a", ",,much,,,,,,,", "one,b,1,<=,1,1,mm,perhaps,,"])
def test_other_files_are_refused(line, tmp_path):
    result_rows.write(tmp_path / "rows.csv", ROWS)
    path = tmp_path / "rows.csv"
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(InputError, match=r"rows.csv: line 6: expected a row of 10 cells"):
        result_rows.read(path)


def test_a_group_is_replaced_where_it_stood():
    new = [replace(ROWS[0], measured=1.0)]
    assert result_rows.renewed(ROWS, "one", new) == [*new, *ROWS[2:]]
    assert result_rows.renewed(ROWS[:2], "two", ROWS[2:]) == ROWS


def test_rows_that_stay_keep_their_places():
    """Behind the row that they stood behind, or first."""
    old = [replace(ROWS[0], what=what, measured=1.0) for what in "abcd"]
    new = [replace(row, measured=2.0) for row in (old[0], old[2])]
    for stay, expected in (("b", "abc"), ("bd", "abcd"), ("", "ac")):
        found = result_rows.renewed([*old, *ROWS[2:]], old[0].group, new, stay.__contains__)
        assert "".join(row.what for row in found[: len(expected)]) == expected and found[len(expected) :] == ROWS[2:]
        assert {row.what for row in found[: len(expected)] if row.measured == 1.0} == set(stay)
    assert [row.what for row in result_rows.renewed(old, old[0].group, new[1:], "a".__contains__)] == ["a", "c"]


def test_groups_that_are_entered_at_once_lose_none(tmp_path):
    """As when two commands measure different groups into one document."""
    page = tmp_path / "page.md"
    page.write_text("<!-- rows -->\n<!-- /rows -->\n")
    groups = [f"group{k}" for k in range(8)]
    choices = [Chosen(group, "", (f"{group} *",)) for group in groups]
    with ThreadPoolExecutor(4) as threads:
        list(threads.map(lambda group: result_rows.enter(page, choices, group, [replace(ROWS[0], group=group)]), groups))
    rows = result_rows.read(page.with_suffix(".csv"))
    assert sorted(row.group for row in rows) == groups
    assert result_rows.short_table(rows, choices) in page.read_text() and "not measured" not in page.read_text()


def test_a_tidy_table_keeps_all_digits_and_other_groups(tmp_path):
    """A row a figure, with its experiment; and another file is left as it is."""
    path, exact = tmp_path / "results.parquet", replace(ROWS[0], measured=1 / 3, experiment="a.b", settings="{}", figure="c_mm")
    result_rows.write_table(path, "one", ROWS[:2])
    result_rows.write_table(path, "two", ROWS[2:])
    result_rows.write_table(path, "one", [exact])
    assert str(result_rows.read_table(path)) == str([exact, *ROWS[2:]])
    path.write_text("not a table")
    with pytest.raises(InputError, match=r"results.parquet: expected results of `sonotwin accuracy`, found"):
        result_rows.read_table(path)


def test_a_whole_table_has_bars_in_both_directions():
    """Of some nothing is asked, and no number meets no bar."""
    assert result_rows.whole_table(ROWS, "peer").splitlines()[2:] == [
        '| an error, "quoted" (paper: 0.1 to 0.2) | 0.0123 mm | <= 0.05 | 0.01 | yes |',
        "| a share | 0.9 | >= 0.97 |  | **no** |",
        "| nothing found | nan px | <= 1 | nan | **no** |",
        "| the peer's | 9.123e+04 ms |  | 0 |  |",
    ]


def test_words_before_a_colon_stand_once():
    """In rows that follow one another; of two colons the last one counts."""
    rows = [replace(ROWS[1], what=what) for what in ("a: b: one", "a: b: two", "a: two", "two", "three", "a: four")]
    cells = [line.split(" | ")[0] for line in result_rows.whole_table(rows, "peer").splitlines()[2:]]
    assert cells == ["| a: b: one", "| – two", "| a: two", "| two", "| three", "| a: four"]


def test_the_worst_row_stands_for_its_choice():
    """Misses first, and one that nobody chose is shown all the same."""
    text = result_rows.short_table(ROWS, [Chosen("errors", "all of one", ("one an error*",)), Chosen("either", "", ("one *",))])
    lines = text.splitlines()[4:]
    assert lines == [
        "| either |  | 0.9, worst of 2 | >= 0.97 |  |  | **no** |",
        "| nothing found | two | nan px | <= 1 |  |  | **no** |",
        "| errors | all of one | 0.0123 mm | <= 0.05 | 0.01 | 0.1 to 0.2 | yes |",
    ]


def test_the_document_is_that_of_its_rows():
    """docs/accuracy.md holds what docs/accuracy.csv and conf/bars/accuracy.yaml give, in 40 rows at most."""
    rows, choices = result_rows.read(result_rows.file_of(DOCUMENT)), result_rows.read_choices(CHOICES)
    assert all(result_rows.chosen_rows(rows, choice) for choice in choices)
    text = result_rows.short_table(rows, choices)
    assert text in DOCUMENT.read_text(encoding="utf-8") and len(text.splitlines()) - 4 <= 40
    missed = text.count("**no**")
    assert all("**no**" in line for line in text.splitlines()[4 : 4 + missed])
