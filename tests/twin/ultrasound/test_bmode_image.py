"""From echoes to grey levels, beside plain NumPy."""

import numpy as np
import pytest

from tests.twin.ultrasound import plain_sound
from twin.ultrasound import bmode_image
from twin.ultrasound.beam import beam
from twin.ultrasound.echo_field import field_like


@pytest.fixture
def echoes(small, rng):
    """A field of random echoes in a narrow image."""
    array = small.model_copy(update={"image_size": (32, 200)})
    parts = rng.standard_normal((*field_like(array, beam(array)).shape, 2), dtype=np.float32)
    return beam(array), parts.view(np.complex64)[..., 0]


def test_pulse_and_beam_are_those_of_the_slow_way(echoes):
    """Both are sums along one axis: 600 terms in float32 leave 1e-5."""
    spread, field = echoes
    slow = plain_sound.focused(field, spread)
    assert np.abs(bmode_image.focused(field, spread) - slow).max() < 1e-5 * np.abs(slow).max()
