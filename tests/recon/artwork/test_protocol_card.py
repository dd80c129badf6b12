"""The protocol card: one page on usual paper, and the same steps as the docs."""

import re
from pathlib import Path

import pypdfium2
import pytest

from recon.artwork import paper_sheet, protocol_card
from recon.artwork.paper_sheet import PAPERS
from recon.artwork.protocol_card import STEPS

DOCS = Path(__file__).parents[3] / "docs/identify.md"


@pytest.mark.parametrize("paper", ["a4", "letter"])
def test_the_card_is_one_page_that_holds_all_steps(tmp_path, paper):
    """The same bytes again, as a sheet that may be replaced."""
    path = tmp_path / "card.pdf"
    assert protocol_card.write(path, PAPERS[paper], 5.0) == 1 and paper_sheet.is_sheet(path)
    before = path.read_bytes()
    protocol_card.write(path, PAPERS[paper], 5.0)
    assert path.read_bytes() == before
    page = pypdfium2.PdfDocument(path)[0].get_textpage()
    text = " ".join(page.get_text_bounded().split())
    for step in STEPS:
        for line in (step.name, step.hints, *step.right, f"{step.minutes} min"):
            assert " ".join(line.split()) in text, line


def test_paper_that_is_too_small_needs_another_page(tmp_path):
    assert protocol_card.write(tmp_path / "card.pdf", (148.0, 210.0), 5.0) > 1


def test_the_docs_have_the_same_table():
    text = DOCS.read_text(encoding="utf-8")
    table = re.search(r"\| minutes \| record \| shows \|\n\|---\|---\|---\|\n((?:\|.*\n)+)", text)[1]
    assert table == "".join(f"| {step.minutes} | {step.record} | {step.shows} |\n" for step in STEPS)
    assert sum(step.minutes for step in STEPS) == 20
