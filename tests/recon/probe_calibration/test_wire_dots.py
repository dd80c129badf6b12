"""Are the dots of N-wires found, each as of its wire, and images without them rejected by name?"""

from dataclasses import replace

import numpy as np
import pytest

from recon.probe_calibration import wire_dots
from tests.recon import bscans, wire_rows
from tests.recon.probe_motions import true_probe
from tests.recon.wire_rows import FCAL


@pytest.fixture
def probe(rig):
    return true_probe(rig)


@pytest.fixture
def dots(probe, rng):
    """Pixels (n, 9, 2) of all wires in ten images, away from their borders."""
    pixels = wire_rows.dots_of(probe, FCAL, wire_rows.poses_over(probe, FCAL, bscans.SIZE, rng, count=40, turn_deg=15.0))
    inside = ((pixels > 12) & (pixels < np.array(bscans.SIZE) - 13)).all(axis=(1, 2))
    apart = np.linalg.norm(pixels[:, 1::3] - pixels[:, ::3], axis=-1).min(axis=1) > 25
    return pixels[inside & apart][:10]


def test_dots_are_found_where_they_are(dots, rng):
    """Among the face's reverberation, a bright bottom and an echo that is none of the wires'."""
    assert len(dots) == 10
    for pixels in dots:
        more = [bscans.face(), bscans.bottom(395.0, 0.02), bscans.spot((rng.uniform(40, 280), 380.0), -15)]
        found = wire_dots.find(wire_rows.drawn(pixels, rng, more), FCAL)
        assert found.reason is None
        away = found.arrangements[0] - pixels
        assert np.abs(away - away.mean(axis=0)).max() < 1.5  # px; the comet tails draw all dots down alike
        assert np.abs(away).max() < 3


def test_images_without_all_wires_are_rejected_by_name(dots, rng):
    assert wire_dots.find(bscans.image(np.zeros((1, 1)), rng), FCAL).reason == "no echo stands out"
    found = wire_dots.find(wire_rows.drawn(dots[0][:7], rng), FCAL)
    assert found.reason == "too few dots: 7 of 9 wires"
    scattered = rng.uniform([20, 60], [300, 380], (12, 2))
    assert wire_dots.find(wire_rows.drawn(scattered, rng), FCAL).reason in (wire_dots.UNLIKE, wire_dots.NO_ROW, "too few dots")


def test_another_phantom_is_not_taken_for_this_one(dots, rng):
    """The same wires but for one side that is in the next hole, 5 mm off."""
    ends = FCAL.ends.copy()
    ends[0, 0, :, 0] -= 5
    other = replace(FCAL, ends=ends)
    for pixels in dots:
        assert wire_dots.find(wire_rows.drawn(pixels, rng), other).reason == wire_dots.UNLIKE


def test_a_phantom_that_looks_alike_from_both_sides_is_seen_both_ways(probe, rng):
    """Two N-wires of one width, one below the other: upright or upside down, from the left or the right."""
    ends = FCAL.ends[:2].copy()
    both = replace(FCAL, ends=ends, names=())
    pixels = wire_rows.dots_of(probe, both, wire_rows.poses_over(probe, both, bscans.SIZE, rng, count=1, turn_deg=5.0))[0]
    found = wire_dots.find(wire_rows.drawn(pixels, rng), both)
    assert len(found.arrangements) == 4
    assert min(np.abs(each - pixels).max() for each in found.arrangements) < 3


def test_an_image_and_a_part_of_it_give_the_same(dots, rng):
    image = wire_rows.drawn(dots[0], rng)
    part = wire_dots.find(image[10:, 4:], FCAL).shifted((4, 10))
    assert part.arrangements == pytest.approx(wire_dots.find(image, FCAL).arrangements, abs=0.2)
    assert part.pixel == pytest.approx(dots[0].mean(axis=0), abs=2)
