"""What the software promises is traced to tests, figures and the README, and the pages made of it say so."""

import re
from fnmatch import fnmatchcase
from importlib import import_module
from pathlib import Path

import pytest

from twin.experiments import result_rows

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def pages(monkeypatch):
    """docs/evidence_pages.py, which makes the pages."""
    pytest.importorskip("sphinx")
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    return import_module("evidence_pages")


@pytest.fixture
def entries(pages):
    """All requirements by name, which stand once."""
    groups = pages.requirements().values()
    found = {name: entry for group in groups for name, entry in group.items()}
    assert len(found) == sum(map(len, groups))
    return found


def test_tests_that_requirements_name_are_there(pages, entries):
    """Each is a test function of a file of today."""
    for name, entry in entries.items():
        for node in entry.tests:
            path, _, test = node.partition("::")
            assert (ROOT / path).is_file(), f"{name}: {path}: no such file"
            assert test in pages.tests_of(path), f"{name}: {node}: no such test"


def test_rows_that_requirements_name_are_there(pages, entries):
    """A row that is gone, or renamed beyond its pattern, changes the number that the pattern finds."""
    for name, entry in entries.items():
        for pattern, count in entry.rows.items():
            found = pages.rows_of(pattern)
            assert len(found) == count, f"{name}: {pattern}: {count} rows stated, found {[row.what for row in found]}"


def test_each_bar_is_a_requirements(pages, entries):
    """What is asked of a figure has a risk, so that a missed bar has one."""
    patterns = [pattern for entry in entries.values() for pattern in entry.rows]
    asked = [f"{row.group} {row.what}" for row in pages.rows() if row.bar is not None]
    assert len(asked) > 500
    assert not [row for row in asked if not any(fnmatchcase(row, pattern) for pattern in patterns)], "in docs/requirements.yaml"


def test_each_row_of_the_readme_is_a_requirements(entries):
    """First cells of its tables, and of no row that isn't there."""
    lines = re.findall(r"^\| *(.*?) *\|", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    told = [cell for cell in lines if cell and not re.fullmatch(r"-+\|?|file", cell)]
    assert len(told) >= 17
    assert sorted(told) == sorted(cell for entry in entries.values() for cell in entry.readme)


def test_marks_of_tests_are_read_from_their_source(pages):
    """Slow ones, and those that need recordings, by decorator and argument."""
    here = pages.tests_of("tests/test_credibility.py")
    assert "test_marks_of_tests_are_read_from_their_source" in here and "pages" not in here
    assert not any(test.slow or test.recorded for test in here.values())
    assert pages.tests_of("tests/test_docs.py")["test_the_readme_runs"].slow
    assert pages.tests_of("tests/recon/freehand/test_sequences.py")["test_the_real_sweep_is_read_whole"].recorded


def test_each_dependency_that_runs_with_us_is_listed(pages):
    """With an exact version; tools of development aren't."""
    assert sorted(pages.soup()) == sorted(pages.direct())
    assert set(pages.direct()) <= set(pages.versions())
    assert {
        "numpy": "core",
        "mitsuba": "twin",
        "torch": "train",
    }.items() <= pages.direct().items() and "ruff" not in pages.direct()
    page = "\n".join(pages.soup_sections().values())
    assert all(f"| {name} {pages.versions()[name]} |" in page for name in pages.direct())


def test_figures_in_words(pages, monkeypatch):
    """The worst, its bar, and how many are missed; rows without a bar don't hide it."""
    rows = (
        result_rows.Row("g", "a: width", 1.0, "<=", 2.0, None, "mm", True),
        result_rows.Row("g", "b: width", 5.0, "<=", 2.0, None, "mm", False),
        result_rows.Row("g", "c: width", 9.0, "", None, None, "mm", None),
        result_rows.Row("g", "a: share", 0.5, ">=", 0.9, None, "", False),
    )
    monkeypatch.setattr(pages, "rows", lambda: rows)
    assert pages.measured("g *width").words == "5 mm (at most 2 asked; worst of 2; 1 missed)"
    assert pages.measured("g a: width").words == "1 mm (at most 2 asked)"
    assert pages.measured("g c: width").words == "9 mm"
    assert pages.measured("g *share; g a: width").words == "0.5 (at least 0.9 asked; worst of 2; 1 missed)"
    assert pages.measured("g *width").source.startswith("g b: width")
    with pytest.raises(ValueError, match="found 0"):
        pages.measured("g d*")


def test_missed_bars_are_anomalies(pages):
    """Each by a line, with a requirement that it concerns."""
    lines = pages.anomaly_sections()["Missed bars"].splitlines()
    missed = [row for row in pages.rows() if row.met is False]
    found = [line for line in lines if re.search(r"\[[A-Z]+-\d+\]\(#[a-z]+-\d+\)", line)]
    assert len(found) == len(missed) > 0


def test_figures_and_requirements_of_the_page_are_there(pages, entries):
    """The build would stop at them; this is sooner."""
    page = (ROOT / "docs" / "credibility.md").read_text(encoding="utf-8")
    looked = re.findall(r"\{(measured|campaign|requirement)\}`([^`]+)`", page)
    assert {role for role, _ in looked} == {"measured", "campaign", "requirement"}
    for role, text in looked:
        assert text in entries if role == "requirement" else getattr(pages, role)(text), text
    with pytest.raises(ValueError, match="found none"):
        pages.campaign("mistakes: no such column")


def test_all_factors_and_categories_are_on_the_page():
    """Thirteen factors of ASME V&V 40 and eight categories of the FDA's guidance, each with what is missing."""
    page = (ROOT / "docs" / "credibility.md").read_text(encoding="utf-8")
    tables = re.findall(r"^\| (?:factor|category) \|.*\n\|[-|]+\n((?:\|.*\n)+)", page, re.MULTILINE)
    cells = [line.strip("|\n ").split(" | ") for table in tables for line in table.splitlines()]
    assert [len(table.splitlines()) for table in tables] == [8, 5, 6, 2]
    assert all(len(line) == 3 and all(len(cell) > 2 for cell in line) for line in cells)
