"""Echo of a round shaft, beside stationary phase for its front, a paraxial ray for its back, and a plate for a thin wall."""

import numpy as np
import pytest

from twin.ultrasound.tool_resonance import BEFORE, TILT_STEP, Layers, resonance, strip_width

K = 2 * np.pi / (1.54 / 7.5)
WATER, STEEL = (1.486, 1488.3, 0.0), (46.0, 5900.0, 0.0)
HARD = (1e6, 1e6, 0.0)
AIR = (0.0004, 343.0, 0.0)
LAMBDA = 1.4883 / 7.5  # mm
R = (46.0 - 1.486) / (46.0 + 1.486)


def rod(radius=0.635, bore=0.0, wall=STEEL, filling=WATER) -> Layers:
    return Layers(radius, bore, WATER, wall, filling, K, 1540.0, 0.06125)


def pulsed(layers: Layers) -> np.ndarray:
    """Envelope of the echo by the usual array's pulse."""
    pulse = np.exp(-0.5 * (np.arange(-6, 7) * 0.06125 / 0.0766) ** 2)
    return np.abs(np.convolve(resonance(layers)[0], pulse, "same"))


@pytest.mark.parametrize(("radius", "tilt_deg"), [(0.255, 0), (0.635, 0), (1.05, 0), (0.635, 30), (0.635, 60)])
def test_a_hard_front_is_a_strip_of_a_mirror(radius, tilt_deg):
    """sqrt(a lambda cos / 2) wide, 45 degrees late; the series has terms of 1 / (16 k a cos) beyond that, 1.4 % at most here."""
    width = strip_width(np.array([K + 0j]), np.radians(tilt_deg), rod(radius, wall=HARD))[0]
    expected = np.sqrt(radius * LAMBDA * np.cos(np.radians(tilt_deg)) / 2) * np.exp(0.25j * np.pi)
    assert width / expected == pytest.approx(1, abs=1.2 / (K * radius * np.cos(np.radians(tilt_deg))))


def test_a_steel_rod_rings_by_its_diameter():
    """Its back, 2 a / c later, as weak as a ray says that spreads in it: |C| = 13.3 / a, against 2 / a of the front.

    Not quite: it runs 14 times as far beside the axis as it came in, where it is paraxial no longer.
    """
    echo = pulsed(rod())
    ring = 2 * 0.635 * 1540 / 5900 / 0.06125  # samples
    front, back = echo[BEFORE - 1 : BEFORE + 2].max(), echo[BEFORE + round(ring)]
    slope = 1488.3 / 5900
    once = 2 * (1 / slope - 1) + 1  # heights at the back and again at the front, by refraction and a concave mirror
    bent = (1 / slope - 1) - 2 * once
    again = once + 2 * bent
    out = slope * (bent - again) + again
    assert 20 * np.log10(back / front) == pytest.approx(20 * np.log10((1 - R**2) * np.sqrt(2 / abs(out))), abs=2.5)


def test_a_thin_wall_is_a_plate():
    """A tube of 8 mm in radius, of 0.2 mm steel: r (1 - e) / (1 - r² e) of a mirror of its radius, e = exp(2 i k d)."""
    k = K * np.linspace(0.8, 1.2, 9)
    layers = rod(8.0, 7.8)
    plate = np.exp(2j * k * 1540 / 5900 * 0.2)
    expected = R * (1 - plate) / (1 - R**2 * plate) * np.sqrt(8.0 * np.pi / (k * 1540 / 1488.3)) * np.exp(0.25j * np.pi)
    found = strip_width(k + 0.02j, 0.0, layers)  # without the far wall's echo, 15.6 mm later: 0.02 * 2 * 16 is 5 dB
    assert np.abs(found / expected - 1).max() < 0.2


def test_beyond_the_critical_angle_nothing_rings():
    """Which is 14.6 degrees: 16 degrees leave the front, and what tunnels; at 0 the ringing is above that."""
    echo = np.abs(resonance(rod()))
    later = slice(BEFORE + 12, BEFORE + 40)
    quiet, loud = (20 * np.log10(echo[row, later].max() / echo[row, BEFORE]) for row in (-1, 0))
    assert TILT_STEP * (len(echo) - 1) == pytest.approx(np.radians(16)) and quiet < loud - 8


def test_water_in_the_bore_shows_its_far_wall_and_air_does_not():
    """As deep as the near wall and the bore are in sound's time, 0.92 mm; nothing passes from steel into air."""
    water, air = (pulsed(rod(bore=0.419, filling=one)) for one in (WATER, AIR))
    beyond = slice(BEFORE + 11, BEFORE + 20)
    assert 20 * np.log10(water[beyond].max() / air[beyond].max()) > 10
    depth = 0.06125 * (11 + water[beyond].argmax())
    assert depth == pytest.approx(0.216 * 1540 / 5900 + 0.838 * 1540 / 1488.3, abs=0.08)


@pytest.mark.parametrize("frequency_mhz", [5.0, 7.5, 15.0])
@pytest.mark.parametrize(("radius", "bore"), [(4.0, 0.0), (1.055, 0.8)])
def test_the_thickest_shafts_have_an_echo(frequency_mhz, radius, bore):
    """A rod of 8 mm, and a wide tube of air: at high orders J and H leave the range of numbers."""
    layers = Layers(radius, bore, WATER, STEEL, AIR, 2 * np.pi * frequency_mhz / 1.54, 1540.0, 0.06125 * 5 / frequency_mhz)
    echo = np.abs(resonance(layers))
    assert np.isfinite(echo).all() and echo[0].argmax() in range(BEFORE, BEFORE + 9), "at its front, or as its wall rings"
    steep = strip_width(np.array([layers.wavenumber + 0.1j]), np.radians(60), layers)[0]
    expected = np.sqrt(radius * 1.4883 / frequency_mhz / 4) * np.exp(0.25j * np.pi)
    assert np.abs(steep) == pytest.approx(np.abs(expected), rel=0.1), "beyond the critical angle all comes back"
