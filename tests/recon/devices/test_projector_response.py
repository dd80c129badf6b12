"""Whether a projector's gamma is measured, and its effect on fringes predicted."""

import numpy as np
import pytest

from recon.devices import projector_response
from recon.devices.interfaces import DeviceError
from recon.devices.pattern_player import Triggered
from recon.devices.projector_response import Response
from recon.model.patterns import Fringes, Patterns
from recon.structured_light.phase import DEFAULT_NOISE, wrapped_phase
from tests.recon.devices.lit_scene import Wall, WallCamera

LEVELS = np.linspace(0, 1, 17)


@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.2, 2.6])
def test_gamma_is_measured(clock, rng, gamma):
    """Of 6144 pixels with 1 DN of noise and rounding of 1/16 of the range apart: 0.5 % of the exponent."""
    wall = Wall(clock, gamma=gamma)
    found = projector_response.measure(wall, WallCamera(wall, rng), Triggered())
    assert found.gamma == pytest.approx(gamma, abs=0.005 * gamma)
    assert found.light == pytest.approx(found.levels**gamma, abs=0.003)
    assert (found.bend > 0.05) == (gamma > 1)
    assert wall.calls == 17 + 3  # no step was taken for one that isn't shown


def test_saturated_white_is_refused(clock, rng):
    wall = Wall(clock)
    with pytest.raises(DeviceError, match=r"^cam1: expected white below 250 DN, found it saturated: shorten the exposure"):
        projector_response.measure(wall, WallCamera(wall, rng, gain=1.2), Triggered())


@pytest.mark.parametrize("steps", [3, 4, 5, 8])
def test_the_predicted_error_is_that_of_decoded_fringes(steps):
    """Fringes of a projector with gamma, decoded as a camera's images are."""
    part, x = Fringes(pitch=16, steps=steps, origin=0), np.arange(0, 16, 0.1)
    turns = x / part.pitch + part.shifts[:, None] / (2 * np.pi)
    light = 200 * ((1 + np.cos(2 * np.pi * turns)) / 2) ** 2.2
    phase = wrapped_phase(np.float32(light)[:, None], part.shifts, noise=DEFAULT_NOISE, saturation=255.0).phase[0]
    error = np.angle(np.exp(1j * (phase - 2 * np.pi * x / part.pitch))) * part.pitch / (2 * np.pi)
    fine = Response(np.linspace(0, 1, 256), np.linspace(0, 1, 256) ** 2.2)
    assert projector_response.fringe_error(fine, part) == pytest.approx(np.abs(error).max(), rel=0.02, abs=1e-4)


def test_bent_fringes_are_named_and_others_are_not():
    three = Patterns(projector_size=(96, 64), unwrap="heterodyne", parts=(Fringes(pitch=18, steps=3), Fringes(pitch=24, steps=8)))
    power = Response(LEVELS, LEVELS**2.2)
    assert "level^2.20, which bends 3 fringes of 18 px by up to " in projector_response.bent_fringes(power, three)
    assert "linearise_gamma=2.20" in projector_response.bent_fringes(power, three)
    assert not projector_response.bent_fringes(Response(LEVELS, LEVELS), three)
    eight = Patterns(projector_size=(96, 64), unwrap="heterodyne", parts=(Fringes(pitch=18, steps=8), Fringes(pitch=24, steps=8)))
    assert not projector_response.bent_fringes(power, eight)
    binary = tuple(Fringes(pitch=pitch, steps=4, waveform="binary", origin=0.5) for pitch in (16, 24))
    assert not projector_response.bent_fringes(power, Patterns(projector_size=(96, 64), unwrap="heterodyne", parts=binary))


@pytest.mark.parametrize("steps", [3, 4, 16, 17])
def test_each_step_is_shown_once_and_far_from_the_one_before(steps):
    order = projector_response._far_apart(steps)
    assert sorted(order) == list(range(steps))
    assert np.abs(np.diff(order)).min() >= max(steps // 2 - 1, 1)
