"""The fan is found in what changes: angles and radii as they were made, whatever lies around it on the screen."""

import numpy as np
import pytest

from recon.clips import fan_region
from recon.errors import InputError
from recon.model.fan import Fan

SHAPE = (420, 560)
FANS = [
    Fan(280.0, -90.0, 130.0, 470.0, -32.0, 32.0),
    Fan(240.0, 20.0, 60.0, 380.0, -25.0, 38.0),  # aside
    Fan(300.0, -260.0, 300.0, 640.0, -18.0, 18.0),  # narrow, of a large radius
    Fan(280.0, -40.0, 80.0, 520.0, -36.0, 36.0),  # longer than the image
]


def frames(fan, rng, count=12):
    """Speckle in the fan, of levels that fall with depth, on a screen with a clock."""
    mask = fan.mask(SHAPE)
    level = 120 - 60 * np.linspace(0, 1, SHAPE[0])[:, None]
    for number in range(count):
        image = np.zeros(SHAPE)
        image[mask] = (level * rng.rayleigh(0.6, SHAPE))[mask]
        image[5:20, 5:60] = 40 + 20 * (number % 3)
        yield np.uint8(np.clip(image, 0, 255))


@pytest.mark.parametrize("fan", FANS)
def test_a_fan_is_found_to_a_degree_and_some_pixels(fan, rng):
    found = fan_region.find(frames(fan, rng), "clip")
    assert abs(found.left_deg - fan.left_deg) < 1 and abs(found.right_deg - fan.right_deg) < 1
    assert abs(found.first_px + found.v - fan.first_px - fan.v) < 4
    there, here = fan.mask(SHAPE), found.mask(SHAPE)
    assert (there & here).sum() / (there | here).sum() > 0.97


def test_what_is_no_fan_is_refused(rng):
    still = [np.full(SHAPE, 30, np.uint8)] * 5
    with pytest.raises(InputError, match="clip: expected a B-scan that changes from frame to frame"):
        fan_region.find(still, "clip")
    rectangle = rng.integers(0, 200, (6, *SHAPE), np.uint8)
    rectangle[:, :50], rectangle[:, :, :80] = 0, 0
    with pytest.raises(InputError, match=r"clip: expected a part between two sides and two arcs .* give fan="):
        fan_region.find(rectangle, "clip")
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    disc = np.hypot(u - 280, v - 210) < 180
    with pytest.raises(InputError, match="two arcs"):
        fan_region.find([np.uint8(disc * one) for one in rng.integers(0, 200, (6, *SHAPE))], "clip")
