"""Whether images that show the pattern before are told from those that changed."""

import numpy as np
import pytest

from recon.artwork import projected_images
from recon.devices import pattern_changes
from recon.model.patterns import CentreLine, Fringes, GrayCode, Patterns, Uniform

SIZE = (192, 128)
SEQUENCE = Patterns(
    projector_size=SIZE,
    unwrap="gray",
    parts=(
        CentreLine(),
        Fringes(pitch=12, steps=8),
        GrayCode(pitch=12, bits=4, complementary=True),
        Uniform(level=0.5),
    ),
)


@pytest.fixture
def see(rng):
    """A camera's image of the light of levels : (h, w); shot noise as of a small sensor, one pixel in four unlit."""
    lit = rng.random(SIZE[::-1]) > 0.25

    def image(pattern, gain=0.7, gamma=1.0):
        level = 8 + gain * lit * 255 * (pattern / 255) ** gamma
        return np.uint8(np.clip(np.rint(level + np.sqrt(0.5 + 0.033 * level) * rng.standard_normal(level.shape)), 0, 255))

    return image


@pytest.mark.parametrize("gamma", [1.0, 2.2])
@pytest.mark.parametrize("gain", [0.15, 0.7, 1.2])
def test_every_change_of_a_sequence_is_seen_and_none_without_one(see, gain, gamma):
    """At weak, good and saturating light; by a projector whose gamma was left as it is."""
    images = list(projected_images.images(SEQUENCE))
    black, white = np.zeros_like(images[0]), np.full_like(images[0], 255)
    light = pattern_changes.measure_light(*(see(one, gain, gamma) for one in (black, white, white)))
    for before, pattern in zip([white, *images], images, strict=False):
        pair, shown = (before, pattern), see(before, gain, gamma)
        assert not pattern_changes.change(light, (shown, see(pattern, gain, gamma)), pair) < 0.15
        assert not pattern_changes.change(light, (shown, see(before, gain, gamma)), pair) > 0.05


def test_half_an_exposure_of_each_pattern_is_a_quarter_of_the_change(see):
    """The mean square of half a difference."""
    one, other = projected_images.images(SEQUENCE)[1:3]
    black, white = np.zeros_like(one), np.full_like(one, 255)
    light = pattern_changes.measure_light(*(see(image) for image in (black, white, white)))
    share = pattern_changes.change(light, (see(one), see(one / 2 + other / 2)), (one, other))
    assert share == pytest.approx(0.25, abs=0.03)  # of the pixels' noise: 0.001; of those that are unlit: 0.02


def test_there_is_no_verdict_on_changes_below_the_noise(see):
    one, other = np.full(SIZE[::-1], 100, np.uint8), np.full(SIZE[::-1], 101, np.uint8)
    light = pattern_changes.measure_light(*(see(image) for image in (0 * one, 0 * one + 255, 0 * one + 255)))
    assert np.isnan(pattern_changes.change(light, (see(one), see(other)), (one, other)))
    assert np.isnan(pattern_changes.change(light, (see(one), see(one)), (one, one)))
