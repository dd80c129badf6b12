"""From echoes to grey levels, beside plain NumPy."""

import numpy as np
import pytest

from tests.twin.ultrasound import plain_sound
from twin.ultrasound import bmode_image
from twin.ultrasound.beam import beam
from twin.ultrasound.echo_field import field_like
from twin.ultrasound.scanner_picture import Picture
from twin.ultrasound.sound_paths import Paths


@pytest.fixture
def narrow(small):
    """An array of a narrow image."""
    return small.model_copy(update={"image_size": (32, 200)})


@pytest.fixture
def echoes(narrow, rng):
    """A field of random echoes."""
    parts = rng.standard_normal((*field_like(narrow, beam(narrow)).shape, 2), dtype=np.float32)
    return beam(narrow), parts.view(np.complex64)[..., 0]


def test_pulse_and_beam_are_those_of_the_slow_way(echoes):
    """Both are sums along one axis: 600 terms in float32 leave 1e-5."""
    spread, field = echoes
    slow = plain_sound.focused(field, spread.axial, spread.lateral, spread.reach)
    assert np.abs(bmode_image.focused(field, spread) - slow).max() < 1e-5 * np.abs(slow).max()


def test_looks_are_those_of_the_slow_way(narrow, echoes, rng):
    """As above, of three directions in two parts of the band, with a focus and edges that change from place to place."""
    spread, field = echoes
    silent = {"aperture_rays": 3, "noise_db": -300, "face_ring_mm": 0, "picture": Picture(bands=2, angles=3)}
    array, still = narrow.model_copy(update=silent), np.zeros((32, 250), np.float32)
    focus, edges = rng.uniform(0, 1, (2, *still.shape)).astype(np.float32)
    deep = still + np.float32(array.scale_mm_per_px[1]) * np.arange(250, dtype=np.float32)
    paths = Paths(array.scale_mm_per_px[1], still.astype(np.uint8), deep, still, still, focus, edges)
    slow = edges[:, :200].T * plain_sound.envelope(field, array, spread, focus[:, :200].T)
    assert np.abs(bmode_image.envelope(field, array, spread, paths, rng) - slow).max() < 1e-5 * slow.max()


def test_clutter_about_a_mirror_darkens_nothing(clean, rng):
    """An echo 70 dB over faint noise: the sum of powers is one everywhere, whatever Fourier's rounding is."""
    array = clean.model_copy(update={"noise_db": -72.0, "picture": Picture(clutter_db=-32.0)})
    field = field_like(array, beam(array))
    field[100:130, 160:166] = 3e3
    paths = Paths(0.1225, np.zeros((321, 490), np.uint8), *(np.ones((321, 490), np.float32) for _ in range(5)))
    assert np.isfinite(bmode_image.envelope(field, array, beam(array), paths, rng)).all()
