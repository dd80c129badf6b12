"""Fans: which pixels of an image belong to one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.model import fan
from recon.model.fan import Fan

ORDINARY = Fan(160.0, -60.0, 90.0, 330.0, -30.0, 35.0)


def test_pixels_lie_between_the_arcs_and_the_sides():
    """By angle and radius; but for a pixel's width at the borders, where scan conversion blends."""
    v, u = np.mgrid[:300, :400]
    radius, angle = np.hypot(u - 160, v + 60), np.rad2deg(np.arctan2(u - 160, v + 60))
    within = (radius > 90) & (radius < 330) & (angle > -30) & (angle < 35)
    mask = ORDINARY.mask((300, 400))
    assert (within & ~mask).sum() < 0.03 * within.sum()
    beyond = mask & ~within
    assert radius[beyond].min() > 88.9 and angle[mask].min() > -30 and angle[mask].max() < 35 and radius[mask].max() < 330


def test_its_area_is_that_of_a_sector():
    whole = Fan(300.0, 5.0, 100.0, 250.0, -40.0, 40.0).mask((300, 600)).sum()
    sector = np.deg2rad(80) / 2 * (250**2 - 100**2)
    border = 2 * 150 + np.deg2rad(80) * 250
    assert sector - 2 * border < whole < sector


@given(st.floats(-200, 500), st.floats(-300, 300), st.floats(0, 300), st.floats(1, 400), st.floats(-80, 70), st.floats(1, 80))
def test_each_column_has_one_piece_of_it(u, v, first, extent, left, opening):
    """As its sides open downwards: so that a bottom is sought from its first row to its last."""
    one = Fan(u, v, first, first + extent, left, min(left + opening, 89.0))
    inside = one.mask((120, 160)).astype(int)
    assert (np.diff(np.pad(inside, ((1, 1), (0, 0))), axis=0) == 1).sum(axis=0).max() <= 1


def test_the_rectangle_about_it():
    mask = np.zeros((30, 40), bool)
    mask[4:9, 11:20] = True
    assert fan.box(mask) == (11, 4, 9, 5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"first_px": 330.0}, "radii: expected two, the less one first, found 330 and 330 px"),
        ({"first_px": -1.0}, "radii: expected two"),
        ({"left_deg": 35.0}, "angles: expected two from -89 to 89, the left one first, found 35 and 35 deg"),
        ({"right_deg": 90.0}, "angles: expected two from -89 to 89"),
    ],
)
def test_nonsense_is_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        Fan(**(ORDINARY.__dict__ | change))
