"""The target on paper, as the tracker finds it in the sheet at 300 dpi."""

import numpy as np
import pytest

from recon.artwork import paper_sheet, target_drawing
from recon.errors import InputError
from recon.model.circle_layout import circle_centres
from recon.tracking import networks, photographs
from tests.recon.artwork.rasters import INK, PAPER, raster, rigid_misfit


@pytest.fixture(scope="module")
def sheet(rig, tmp_path_factory):
    """The raster of a sheet with the target, and the size of its pixels, mm; and what the tracker finds in it."""
    tmp_path = tmp_path_factory.mktemp("sheet")
    card = target_drawing.card_of(rig.target)
    laid = paper_sheet.lay_out(card.size, paper_sheet.PAPERS["a4"], 5.0)
    lines = ["in bold", target_drawing.in_words(rig.target)]
    paper_sheet.write(tmp_path / "target.pdf", [paper_sheet.Page(card, laid, lines)], 5.0, "target")
    image, pixel = raster(tmp_path / "target.pdf", 300)
    return image, pixel, photographs.find(image, networks.load(), rig.target)


def test_the_tracker_finds_it_true_to_scale(rig, sheet):
    """Centres by their names, distances and diameters within 0.02 mm; upright, with c2 above c0. A mirrored sheet is refused."""
    image, pixel, view = sheet
    assert view.found, view.reason
    places = view.outlines.ellipses.centre * pixel * [1, -1]
    off, turn = rigid_misfit(places, circle_centres(rig.target)[:, :2])
    assert off < 0.02 and abs(turn) < 1e-4
    assert np.abs(2 * view.outlines.ellipses.semi_axes * pixel.mean() - rig.target.outer_diameter_mm).max() < 0.02
    assert not photographs.find(np.ascontiguousarray(image[:, ::-1]), networks.load(), rig.target).found


def test_rings_have_the_area_of_both_diameters(rig, sheet):
    """Of each ring, within what 0.02 mm of the inner diameter make; marks and letters lie farther off."""
    image, pixel, view = sheet
    outer, inner = rig.target.outer_diameter_mm, rig.target.inner_diameter_mm
    ink = (PAPER - image.astype(float)) / (PAPER - INK)
    reach = int((outer / 2 + 1) / pixel.min())
    for u, v in np.rint(view.outlines.ellipses.centre).astype(int):
        area = ink[v - reach : v + reach, u - reach : u + reach].sum() * pixel.prod()
        assert abs(area - np.pi / 4 * (outer**2 - inner**2)) < np.pi / 2 * inner * 0.02


def test_a_board_too_small_for_the_circles_is_refused(rig):
    small = rig.target.model_copy(update={"board_mm": (45.0, 65.0)})
    with pytest.raises(InputError, match=r"rig.target.board_mm: expected 47x62 mm or more around these circles, found 45x65 mm"):
        target_drawing.card_of(small)
