"""A needle's tip is found where it is, whatever is expected, and what shows none is told apart."""

from dataclasses import replace

import numpy as np
import pytest

from recon.probe_calibration import needle_echo
from recon.probe_calibration.needle_echo import Expected
from tests.recon import bscans, needle_scans
from tests.recon.needle_scans import SCALE, echo_of, image, rod

TIP = np.array([22.0, 28.0, 0.0])  # mm, in the image's frame
MM_PX = 1 / SCALE.mean()


def near(found, pixel, mm):
    assert found.found, found.reason
    assert np.linalg.norm((found.pixel - pixel) * SCALE) < mm


@pytest.mark.slow
@pytest.mark.parametrize("medium", ["water", "gelatin", "silicone"])
def test_tips_are_found_to_a_quarter_of_a_millimetre(medium):
    """Half of 16 needles at all angles within 0.2 mm, 95 % within 0.6 mm, with a covariance that has them: chi-square, 2."""
    rng, errors, squared = np.random.default_rng(3), [], []
    for k in range(16):
        tip = np.array([rng.uniform(12, 28), rng.uniform(12, 40), 0.2 * rng.standard_normal()])
        wire = rod(tip, rng.uniform(5, 55), 0.5 * rng.standard_normal(), rng.choice([-1, 1]))
        found = needle_echo.find(image(medium, wire, seed=k))
        if found.found:
            off = found.pixel - echo_of(tip, medium)
            errors.append(np.linalg.norm(off * SCALE))
            squared.append(off @ np.linalg.solve(found.covariance, off))
    assert len(errors) >= 13 and np.median(errors) < 0.2 and np.percentile(errors, 95) < 0.6
    assert 0.3 < np.median(squared) < 2.8, "1.39 of two normal numbers"


def test_what_is_expected_moves_no_tip():
    scan, pixel = image("gelatin", rod(TIP, 30.0)), echo_of(TIP, "gelatin")
    alone = needle_echo.find(scan)
    near(alone, pixel, 0.3)
    for off in ([3 * MM_PX, 0], [0, -3 * MM_PX]):
        expected = Expected(pixel + off, 0.1 * np.eye(2), np.array([0.8, 0.6]))
        assert np.array_equal(needle_echo.find(scan, None, expected).pixel, alone.pixel)


def test_what_ends_far_from_where_tracking_has_the_tip_is_none():
    """Such as skin, or another needle: 15 mm off, beyond what poses and calibrations leave open."""
    expected = Expected(echo_of(TIP, "water") + np.array([0, 15 * MM_PX]), np.eye(2))
    assert needle_echo.find(image("water", rod(TIP, 30.0)), None, expected).reason == needle_echo.FAR


def test_what_is_expected_chooses_among_needles():
    other = np.array([20.0, 12.0, 0.0])
    scan = image("water", rod(TIP, 25.0), rod(other, 20.0))
    assert (needle_echo.find(scan).reason or "").startswith("two candidates: shafts about")
    for tip in (TIP, other):
        pixel = echo_of(tip, "water")
        near(needle_echo.find(scan, None, Expected(pixel + 10, 4 * np.eye(2))), pixel, 0.3)


def test_of_a_shaft_with_both_ends_in_the_image_the_deeper_one_is_the_tip_or_the_one_that_is_expected():
    scan = image("water", rod(TIP, 25.0, length_mm=16.0))
    near(needle_echo.find(scan), echo_of(TIP, "water"), 0.3)
    tail = TIP - 16 * np.array([np.cos(np.radians(25)), np.sin(np.radians(25)), 0])
    back = Expected(echo_of(tail, "water"), np.eye(2), np.array([-0.9, -0.4]))
    near(needle_echo.find(scan, None, back), echo_of(tail, "water"), 0.6)
    near(needle_echo.find(scan, None, replace(back, direction=None)), echo_of(tail, "water"), 0.6)


def test_a_shaft_across_the_plane_is_a_spot():
    found = needle_echo.find(image("water", rod(TIP, 10.0, 75.0)))
    near(found, echo_of(TIP, "water"), 0.3)
    assert found.shaft is None


def test_a_spot_far_from_where_tracking_has_the_tip_is_none():
    scan, pixel = image("water", rod(TIP, 10.0, 75.0)), echo_of(TIP, "water")
    assert needle_echo.find(scan, None, Expected(pixel + np.array([0, 15 * MM_PX]), np.eye(2))).reason == needle_echo.FAR
    near(needle_echo.find(scan, None, Expected(pixel + np.array([0, 3 * MM_PX]), np.eye(2))), pixel, 0.3)


@pytest.mark.parametrize(("wires", "reason"), [
    ((), "no echo stands out"),
    ((rod([45.0, 30.0, 0.0], 10.0),), "ends at the image's border"),
    ((rod([24.0, 28.0, 3.0], 20.0, 8.0),), "fades out over"),
])  # fmt: skip
def test_what_shows_no_tip_is_told_apart(wires, reason):
    assert (needle_echo.find(image("water", *wires)).reason or "").startswith(reason)


def test_neither_speckle_nor_a_bottom_is_a_needle(rng):
    assert not needle_echo.find(image("gelatin")).found
    bottom = bscans.image(bscans.bottom(250.0, 0.05) + bscans.face(), rng)
    assert not needle_echo.find(bottom).found


def test_a_bottom_below_is_no_rival(rng):
    """It goes from border to border."""
    scan = np.maximum(image("water", rod(TIP, 25.0)), bscans.image(bscans.bottom(370.0), rng))
    near(needle_echo.find(scan), echo_of(TIP, "water"), 0.3)


@pytest.mark.parametrize("content", [np.zeros((408, 321)), np.full((408, 321), 255), np.zeros((20, 20)), np.zeros((3, 40, 40))])
def test_images_without_content_are_rejected(content):
    found = needle_echo.find(content.astype(np.uint8))
    assert not found.found and np.isnan(found.pixel).all()


def test_a_part_of_an_image_is_shifted_back():
    scan = image("water", rod(TIP, 25.0))
    whole, part = needle_echo.find(scan), needle_echo.find(scan[30:, 40:]).shifted((40, 30))
    assert np.linalg.norm(whole.pixel - part.pixel) < 0.3 and np.linalg.norm(whole.shaft[1] - part.shaft[1]) < 0.3


@pytest.mark.parametrize("dip_deg", [15.0, 25.0, 35.0, 45.0])
def test_the_point_of_a_bevel_is_found_aside_from_the_shafts_line(dip_deg):
    """It lies on the wall, a radius beside the axis, and shines by what it diffracts."""
    found = needle_echo.find(needle_scans.bevelled(TIP, dip_deg))
    near(found, np.array([TIP[0], TIP[1] * 1540 / 1488.3]) / SCALE, 0.4)
