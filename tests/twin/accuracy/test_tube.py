"""The inner cylinder in few slices: the rows of the accuracy table hold, and the scanner's own depths would not do."""

from pathlib import Path

import pytest
import yaml

from recon import water
from twin.accuracy import tube
from twin.ultrasound.transducer import Transducer

SLICES = 7


@pytest.fixture(scope="module")
def recorded(rig):
    return tube.stroke(rig.probe, SLICES, 3)


def test_diameter_of_the_inner_cylinder(rig, recorded):
    """Within 0.15 mm, and within 2.5 of its own sigma, which poses wrong by some 0.1 mm a slice make a few hundredths of a mm."""
    rows = tube.judged(recorded, rig.probe, "few")
    assert len(recorded.images) == SLICES
    diameter, found = rows[0], rows[1]
    assert found.measured == 1
    assert diameter.ok and diameter.limit is not None
    assert 0.005 < diameter.limit < 0.15
    assert diameter.measured < 2.5 * diameter.limit


def test_depths_at_the_speed_that_the_scanner_assumes_are_wrong(rig, recorded):
    """Stretched by 3.5 % in depth, the front of the wall is that of a thinner tube."""
    diameters = [2 * tube.measured(recorded, rig.probe, speed)[1].shape.radius for speed in (1540.0, water.speed_of_sound(22.0))]
    assert diameters[0] < diameters[1] - 0.3


def test_the_array_is_that_of_the_configuration():
    path = Path(__file__).parents[3] / "conf" / "ultrasound" / "water.yaml"
    assert Transducer(**yaml.safe_load(path.read_text(encoding="utf-8"))) == tube.WATER
