"""Rows in a file: read as written, replaced a group at a time, shown misses first; and those of the docs."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from recon.errors import InputError
from twin.experiments import kept_rows
from twin.experiments.kept_rows import Chosen, kept
from twin.experiments.table_rows import Row

ROOT = Path(__file__).resolve().parents[3]
DOCUMENT = ROOT / "docs" / "accuracy.md"
CHOICES = ROOT / "conf" / "bars" / "accuracy.yaml"
ROWS = [
    kept("one", Row("a", 'an error, "quoted" (paper: 0.1 to 0.2)', 0.0123, 0.05, 0.01, "mm"), "2026-01-01", "1a2b3c4"),
    kept("one", Row("b", "a share", 0.9, 0.97, None, "", at_least=True), "2026-01-01", "1a2b3c4"),
    kept("two", Row("a", "nothing found", math.nan, 1.0, math.nan, "px"), "2026-01-02", ""),
    kept("two", Row("a", "the peer's", 91230.0, None, 0.0, "ms"), "2026-01-02", ""),
]


def test_rows_are_read_as_written(tmp_path):
    """Each cell, with commas, quotes, no bar and no number."""
    path = tmp_path / "rows.csv"
    assert kept_rows.read(path) == []
    kept_rows.write(path, ROWS)
    assert str(kept_rows.read(path)) == str(ROWS)  # two NaN are not equal


def test_a_verdict_is_kept_though_digits_are_not(tmp_path):
    """0.050001 misses a bar of 0.05, and its four digits would not."""
    kept_rows.write(tmp_path / "rows.csv", [kept("one", Row("a", "", 0.050001, 0.05, None, ""), "", "")])
    assert kept_rows.read(tmp_path / "rows.csv")[0].met is False


@pytest.mark.parametrize("line", ["one,a", ",,,much,,,,,,,", "one,a,b,1,<=,1,1,mm,perhaps,,"])
def test_other_files_are_refused(line, tmp_path):
    kept_rows.write(tmp_path / "rows.csv", ROWS)
    path = tmp_path / "rows.csv"
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(InputError, match=r"rows.csv: line 6: expected a row of 11 cells"):
        kept_rows.read(path)


def test_a_group_is_replaced_where_it_stood():
    new = [replace(ROWS[0], measured=1.0)]
    assert kept_rows.renewed(ROWS, "one", new) == [*new, *ROWS[2:]]
    assert kept_rows.renewed(ROWS[:2], "two", ROWS[2:]) == ROWS


def test_groups_that_are_entered_at_once_lose_none(tmp_path):
    """As when two commands measure different groups into one document."""
    page = tmp_path / "page.md"
    page.write_text("<!-- rows -->\n<!-- /rows -->\n")
    groups = [f"group{k}" for k in range(8)]
    choices = [Chosen(group, "", (f"{group} *",)) for group in groups]
    with ThreadPoolExecutor(4) as threads:
        list(threads.map(lambda group: kept_rows.enter(page, choices, group, [Row("a", "x", 1.0, 2.0, None, "mm")]), groups))
    rows = kept_rows.read(page.with_suffix(".csv"))
    assert sorted(row.group for row in rows) == groups
    assert kept_rows.short_table(rows, choices) in page.read_text() and "not measured" not in page.read_text()


def test_the_worst_row_stands_for_its_choice():
    """Misses first, and one that nobody chose is shown all the same."""
    text = kept_rows.short_table(ROWS, [Chosen("errors", "all of one", ("one a *",)), Chosen("either", "", ("one *",))])
    lines = text.splitlines()[4:]
    assert lines == [
        "| either |  | 0.9, worst of 2 | >= 0.97 |  |  | **no** |",
        "| nothing found | two, row a | nan px | <= 1 |  |  | **no** |",
        "| errors | all of one | 0.0123 mm | <= 0.05 | 0.01 | 0.1 to 0.2 | yes |",
    ]


def test_the_document_is_that_of_its_rows():
    """docs/accuracy.md holds what docs/accuracy.csv and conf/bars/accuracy.yaml give, in 40 rows at most."""
    rows, choices = kept_rows.read(kept_rows.file_of(DOCUMENT)), kept_rows.read_choices(CHOICES)
    assert all(kept_rows.chosen_rows(rows, choice) for choice in choices)
    text = kept_rows.short_table(rows, choices)
    assert text in DOCUMENT.read_text(encoding="utf-8") and len(text.splitlines()) - 4 <= 40
    missed = text.count("**no**")
    assert all("**no**" in line for line in text.splitlines()[4 : 4 + missed])
