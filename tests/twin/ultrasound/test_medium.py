"""Speckle: its statistics, and that it belongs to the tissue and not to the image."""

import numpy as np
import pytest
from scipy.integrate import quad

from tests.twin.ultrasound.phantoms import down
from twin.ultrasound import image
from twin.ultrasound.beam import beam
from twin.ultrasound.medium import scatter
from twin.ultrasound.paths import follow
from twin.ultrasound.scan import scan

FACE = (3.0, -2.0, 650.0)


def echoes(body, transducer, pose, seed=1):
    spread = beam(transducer)
    return image.focused(scatter(body, transducer, spread, follow(body, transducer, pose), pose, seed), spread)


def correlation(a, b):
    """Complex correlation of two fields."""
    return np.vdot(a, b) / np.sqrt(np.vdot(a, a).real * np.vdot(b, b).real)


def test_speckle_is_fully_developed(speckle, clean):
    """Rayleigh: mean over standard deviation of the envelope is sqrt(pi / (4 - pi)) = 1.91, and the intensity's is 1."""
    envelope = scan(speckle, clean, down(clean, FACE), 1).envelope[80:]
    assert envelope.mean() / envelope.std() == pytest.approx(1.91, abs=0.1)
    intensity = envelope**2
    assert intensity.mean() / intensity.std() == pytest.approx(1, abs=0.08)


def test_reference_tissue_has_its_power_at_every_depth(speckle, clean):
    """Mean intensity is 1 after the gain. A band of 3 mm holds about 1000 cells, so 5 sigma are 0.7 dB."""
    frames = np.stack([scan(speckle, clean, down(clean, FACE), seed).envelope for seed in (1, 2)])
    bands = (frames[:, 40:400] ** 2).reshape(2, 15, 24, -1).mean(axis=(0, 2, 3))
    assert np.abs(10 * np.log10(bands)).max() < 1.0


def test_speckle_stays_with_the_tissue(speckle, small):
    """Moved along the array by ten lines, the image shows the same speckle ten lines beside; elsewhere it shows another."""
    first, second = (echoes(speckle, small, down(small, (x, -2.0, 650.0))) for x in (3.0, 3.0 + 10 * small.scale_mm_per_px[0]))
    here, there = first[40:, 24:-14], second[40:, 14:-24]
    assert abs(correlation(here, there)) > 0.99
    assert abs(correlation(first[40:], echoes(speckle, small, down(small, FACE), seed=2)[40:])) < 0.1


@pytest.mark.parametrize("moved", [0.25, 0.5, 0.8])
def test_decorrelation_across_the_plane_follows_van_cittert_and_zernike(speckle, clean, moved):
    """At the lens's focus the beam both ways is the transform of the aperture with itself, a triangle; so speckle that has
    moved by d correlates as the transform of the triangle squared at d h / (lambda F), whatever the tables say."""
    rows = np.abs(clean.rows_mm - clean.elevation_focus_mm) < 3
    first, second = (echoes(speckle, clean, down(clean, (3.0, y, 650.0)))[rows] for y in (-2.0, -2.0 + moved))
    turns = 2 * np.pi * moved * clean.elevation_mm / (clean.wavelength_mm * clean.elevation_focus_mm)
    expected = 3 * quad(lambda u: (1 - u) ** 2 * np.cos(turns * u), 0, 1)[0]
    assert abs(correlation(first, second)) == pytest.approx(abs(expected), abs=0.1)
