"""Blocks of a page as a narrow window needs them."""

import pytest

from recon.reports import page


@pytest.mark.parametrize(
    ("cell", "shown"),
    [
        ("0.160 mm", "0.160\u00a0mm"),
        ("0.0581 ± 0.0090 mm", "0.0581\u00a0±\u00a00.0090\u00a0mm"),
        ("−0.003 ± 0.010 mm", "−0.003\u00a0±\u00a00.010\u00a0mm"),
        ("466 mm³, −29 mm³", "466\u00a0mm³, −29\u00a0mm³"),
        ("48.6 to 51.3 ms (95 %)", "48.6 to 51.3\u00a0ms (95\u00a0%)"),
        ("107 of 107 frames", "107 of 107 frames"),
        ("40 minutes", "40 minutes"),
    ],
)
def test_a_number_stays_beside_its_unit(cell, shown):
    """And only there: words may go onto the next line."""
    assert f"<td>{shown}</td>" in page.table(("", "found", "said"), [("a", cell, "b")])


def test_what_is_said_below_a_table_does_not_scroll_with_it():
    """In a window narrower than the table it would be cut."""
    inner, _, below = page.table(("a", "b"), [("1", "2")], "a long sentence").partition("</div>")
    assert inner.startswith('<div class="scroll"') and "sentence" not in inner and "a long sentence" in below


def test_thousands_stay_together():
    assert page.count(1310338) == "1\u202f310\u202f338"
