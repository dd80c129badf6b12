"""The protocol card: one page on usual paper, and the same steps as the docs."""

import re
from pathlib import Path

import pypdfium2
import pypdfium2.raw as pdfium_c
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


@pytest.mark.parametrize("paper", ["a4", "letter"])
def test_text_keeps_clear_of_the_boxes(tmp_path, paper):
    """By 6 points or more, of all lines beside the boxes of the steps; commands run below these."""
    path = tmp_path / "card.pdf"
    protocol_card.write(path, PAPERS[paper], 5.0)
    page = pypdfium2.PdfDocument(path)[0]
    drawn = [one.get_bounds() for one in page.get_objects(filter=[pdfium_c.FPDF_PAGEOBJ_PATH])]
    small = [one for one in drawn if max(abs(one[2] - one[0] - 8.5), abs(one[3] - one[1] - 8.5)) < 1]  # boxes with their lines
    column = max(left for left, *_ in small)
    heights = [bottom for left, bottom, *_ in small if left > column - 1]
    assert len(heights) == sum(len(step.right) for step in STEPS)
    text = page.get_textpage()
    lines = [(text.get_rect(k), text.get_text_bounded(*text.get_rect(k))) for k in range(text.count_rects())]
    beside = [
        rect[2]
        for rect, said in lines
        if "session" not in said and rect[0] < column and min(heights) - 9 < rect[1] and rect[3] < max(heights) + 9
    ]
    assert len(beside) > 3 * len(STEPS) and max(beside) < column - 6


def test_paper_that_is_too_small_needs_another_page(tmp_path):
    assert protocol_card.write(tmp_path / "card.pdf", (148.0, 210.0), 5.0) > 1


def test_the_docs_have_the_same_table():
    text = DOCS.read_text(encoding="utf-8")
    table = re.search(r"\| minutes \| record \| shows \|\n\|---\|---\|---\|\n((?:\|.*\n)+)", text)[1]
    assert table == "".join(f"| {step.minutes} | {step.record} | {step.shows} |\n" for step in STEPS)
    assert sum(step.minutes for step in STEPS) == 20
