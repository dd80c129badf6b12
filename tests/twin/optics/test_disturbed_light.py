"""Frames with errors: light as strong as drawn, and none of them in ideal conditions."""

import numpy as np
import pytest

from recon.model.patterns import Fringes, GrayCode, Patterns
from recon.structured_light.phase import design
from twin.conditions import Frames, draw
from twin.optics.disturbed_light import emitted, with_stray
from twin.optics.raster import Light
from twin.sensor import Exposure, electrons_per_radiance, expose

LIFE = Frames(flicker=0.02, stray_dn=1.5, shift=0.03)
FRINGES, CODE = Fringes(pitch=16, steps=8), GrayCode(pitch=16, bits=7)
PATTERNS = Patterns(projector_size=(1280, 800), unwrap="gray", parts=(FRINGES, CODE))


def test_what_the_projector_emits_has_the_errors(rig):
    """With a gamma of 1: fringes fitted with the shifts drawn leave the gains drawn, and nothing else; the code has its gains."""
    projector = rig.projector.model_copy(update={"gamma": 1.0, "contrast": 1e9})
    errors = draw(LIFE, PATTERNS.count, 5)
    light, ideal = emitted(PATTERNS, projector, errors), Light.of(PATTERNS, projector)
    x = np.arange(1280) - 639.5
    phase = 2 * np.pi * x / 16
    expected = (
        design(FRINGES.shifts + errors.shift[:8] * 2 * np.pi / 8) @ np.stack([np.ones(1280), np.cos(phase), np.sin(phase)]) / 2
    )
    fringes = np.array(light.profiles[:8]) / errors.gain[:8, None]
    assert np.abs(fringes - expected).max() < 1 / 255
    for shown, was, gain in zip(light.profiles[8:], ideal.profiles[8:], errors.gain[8:], strict=True):
        np.testing.assert_allclose(shown, gain * was, rtol=1e-6)


def test_ideal_conditions_change_nothing(rig):
    """The same light, and the same radiance."""
    errors, images = draw(Frames(), PATTERNS.count, 5), np.ones((PATTERNS.count, 4, 6), np.float32)
    for shown, was in zip(
        emitted(PATTERNS, rig.projector, errors).profiles, Light.of(PATTERNS, rig.projector).profiles, strict=True
    ):
        np.testing.assert_array_equal(shown, was)
    assert with_stray(images, errors.stray_dn, rig.cam1, 525, Exposure(0.01)) is images


@pytest.mark.parametrize("bits", [8, 10])
def test_stray_light_is_in_digital_numbers(rig, bits):
    """A mean image of 3 DN of 255 more, and of 2 DN less."""
    exposure = Exposure(0.01, 1.0, bits)
    grey = 0.4 * rig.cam1.sensor.saturation_e / (electrons_per_radiance(rig.cam1, 525) * exposure.time_s)
    images = np.full((3, 200, 200), grey, np.float32)
    added = with_stray(images, np.array([0.0, 3.0, -2.0]), rig.cam1, 525, exposure)
    means = expose(added, rig.cam1, 525, exposure, 1).astype(float).mean(axis=(1, 2)) / 2 ** (bits - 8)
    assert means[1:] - means[0] == pytest.approx([3.0, -2.0], abs=0.06)
