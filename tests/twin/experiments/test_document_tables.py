"""Tables in documents: what is around them stays, and the state of the code stands over them."""

import re
import subprocess

import pytest

from recon.errors import InputError
from twin.experiments.document_tables import measured_line, refresh


def test_a_document_keeps_what_is_around_the_table(tmp_path):
    """Only what stands between the group's marks changes, and again gives the same."""
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- one -->\nold\n<!-- /one -->\nbetween\n<!-- two -->\n<!-- /two -->\nafter\n")
    for _ in range(2):
        refresh(page, "one", "| id |\n|---|\n| a |")
    text = page.read_text()
    assert re.match(r"before\n<!-- one -->\n\nMeasured \d{4}-\d\d-\d\d\.\n\n\| id \|", text) and text.count("Measured") == 1
    assert text.endswith("<!-- /one -->\nbetween\n<!-- two -->\n<!-- /two -->\nafter\n")
    assert "old" not in text and text.count("| a |") == 1
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
