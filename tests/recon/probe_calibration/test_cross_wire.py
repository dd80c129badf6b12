"""The crossing of two wires is found to a tenth of a pixel, and every rejected image says why."""

import numpy as np
import pytest

from recon.probe_calibration import cross_wire
from recon.probe_calibration.cross_wire import Appearance
from tests.recon import bscans

PLACE = np.array([150.3, 210.7])
NOTHING = 0 * bscans.face()


@pytest.mark.parametrize("peak_db", [-20, -3, 2])
def test_the_spot_is_found_to_a_tenth_of_a_pixel(rng, peak_db):
    """Dim, bright and clipped at its top (2 dB above white), with side lobes and a comet tail."""
    for _ in range(6):
        place = rng.uniform([30, 60], [290, 380])
        found = cross_wire.find(bscans.image(bscans.spot(place, peak_db) + bscans.face(), rng))
        assert found.found, found.reason
        assert (np.abs(found.pixel - place) < [0.3, 0.1]).all()  # wider along the array than in depth


def test_the_covariance_covers_the_error(rng):
    """Near the noise floor, where the noise and not the floor of the covariance decides."""
    z = []
    for _ in range(30):
        place = rng.uniform([60, 60], [260, 350])
        found = cross_wire.find(bscans.image(bscans.spot(place, -26, tail_db=-60), rng, floor_db=-46))
        if not found.found:  # too rough a top
            continue
        z.append((found.pixel - place) @ np.linalg.solve(found.covariance, found.pixel - place))
    assert len(z) > 20 and 0.3 < np.mean(z) / 2 < 2.0


@pytest.mark.parametrize("slope", [0.0, 0.1, -0.4])
def test_the_tank_is_no_wire(rng, slope):
    """Reverberation at the face and a bottom, brighter than the wire, level or tilted."""
    amplitude = bscans.spot(PLACE, -12) + bscans.face() + bscans.bottom(320, slope, peak_db=-2)
    found = cross_wire.find(bscans.image(amplitude, rng))
    assert np.abs(found.pixel - PLACE).max() < 0.3


@pytest.mark.parametrize("second_db", [-6, -12])
def test_a_reverberation_below_is_no_rival(rng, second_db):
    amplitude = bscans.spot((160, 150), 0) + bscans.spot((162, 300), second_db)
    assert np.abs(cross_wire.find(bscans.image(amplitude, rng)).pixel - [160, 150]).max() < 0.3


REJECTED = {
    "no echo stands out": NOTHING,
    "two candidates": bscans.spot((100, 200)) + bscans.spot((180, 205), -6),
    "saturated": bscans.spot(PLACE, 12),
    "at the border": bscans.spot((2, 200)),
    "blurred": bscans.spot(PLACE, -3, sigma_mm=(2.2, 0.3)),
    "only drawn-out echoes": bscans.bottom(250, 0.3),
}


@pytest.mark.parametrize("reason", REJECTED)
def test_a_rejected_image_says_why(rng, reason):
    found = cross_wire.find(bscans.image(REJECTED[reason], rng))
    assert found.reason is not None and found.reason.startswith(reason)
    assert np.isnan(found.pixel).all()


@pytest.mark.parametrize("amplitude", [bscans.face(), bscans.bottom(250), bscans.face() + bscans.bottom(300)])
def test_a_tank_without_wires_has_no_crossing(rng, amplitude):
    assert not cross_wire.find(bscans.image(amplitude, rng)).found


def test_wires_that_cross_beside_the_image_plane_are_two_candidates(rng):
    amplitude = bscans.spot((150, 200)) + bscans.spot((172, 203))
    assert cross_wire.find(bscans.image(amplitude, rng)).reason.startswith("two candidates")


def arm(place, slope, length_px, beside_px, peak_db=-6.0):
    """Amplitude of a wire drawn out along a line through a place, brightest beside it."""
    u, v = np.meshgrid(np.arange(bscans.SIZE[0]) - place[0], np.arange(bscans.SIZE[1]) - place[1])
    along = np.exp(-((u - beside_px) ** 2) / (2 * length_px**2))
    return 10 ** (peak_db / 20) * along * np.exp(-((v - slope * u) ** 2) / (2 * 1.3**2))


@pytest.mark.parametrize(("first", "second"), [(0.5, -0.4), (0.3, -0.1), (-0.6, 0.1)])
def test_oblique_wires_cross_where_their_lines_meet(rng, first, second):
    """The brightest points lie 9 and 6 px beside the crossing; where lines meet is off by less, and as sure as said."""
    for _ in range(4):
        place = rng.uniform([80, 80], [240, 330])
        amplitude = arm(place, first, 18, 9) + 1j * arm(place, second, 14, -6) + bscans.face()
        found = cross_wire.find(bscans.image(amplitude, rng))
        assert found.found, found.reason
        error = found.pixel - place
        assert (np.abs(error) < [2, 1]).all()
        assert error @ np.linalg.solve(found.covariance, error) < 13.8  # chi-square with 2, 1 of 1000


def test_a_line_that_runs_into_the_face_doesnt_cross_it(rng):
    """The face's ring is as bright along its whole row: no second line, however near the crossing is."""
    place = np.array([150.3, 40.7])
    amplitude = arm(place, 0.5, 24, 0) + 1j * arm(place, -0.4, 10, 0) + bscans.face(2)
    found = cross_wire.find(bscans.image(amplitude, rng))
    assert found.found, found.reason
    assert (np.abs(found.pixel - place) < [2, 1]).all()


def test_the_wires_directions_are_those_of_the_lines(rng):
    found = cross_wire.find(bscans.image(arm(PLACE, 0.5, 18, 9) + 1j * arm(PLACE, -0.4, 14, -6), rng))
    slopes = np.sort(found.directions[:, 1] / found.directions[:, 0])
    assert slopes == pytest.approx([-0.4, 0.5], abs=0.05)


def test_a_spot_has_no_directions(rng):
    assert cross_wire.find(bscans.image(bscans.spot(PLACE), rng)).directions is None


def test_one_oblique_wire_is_no_crossing(rng):
    assert not cross_wire.find(bscans.image(arm(PLACE, 0.4, 25, 0), rng)).found


def test_a_scanner_of_another_dynamic_range(rng):
    """Levels are decibels: 60 dB drawn as 40 leave less grey, and the same place."""
    level = bscans.image(bscans.spot(PLACE), rng).astype(float)
    steeper = np.clip(255 - (255 - level) * 1.5, 0, 255).astype(np.uint8)
    found = cross_wire.find(steeper, Appearance(dynamic_range_db=40))
    assert np.abs(found.pixel - PLACE).max() < 0.3


@pytest.mark.parametrize("image", [np.zeros((400, 300)), np.full((400, 300), 255), np.zeros((5, 5)), np.zeros((40, 40, 3))])
def test_images_of_nothing_are_rejected(image):
    assert not cross_wire.find(image.astype(np.uint8)).found
