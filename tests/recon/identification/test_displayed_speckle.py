"""Displayed speckle: series beside drawn powers, and lines between which columns are interpolated."""

import numpy as np
import pytest

from recon.freehand import sequences
from recon.identification import displayed_speckle, speckle
from recon.identification.grey_map import Curve
from tests.recon.identification import scanner_draws
from tests.recon.session import speckle_captures
from twin.ultrasound.scanner_picture import Picture
from twin.ultrasound.transducer import Transducer

BENT = Curve(np.array([1.0, 30.0, 120.0, 220.0, 250.0]), np.array([-25.0, -12.0, 0.0, 8.0, 18.0]))


@pytest.mark.parametrize("looks", [1, 3])
def test_mean_spread_and_correlation_of_greys_are_the_series(rng, looks):
    """2x10^5 pairs of powers of looks, whose fields correlate by 0.8: to 1 % of the spread, and 0.01."""
    alike = 0.8
    fields = rng.standard_normal((2, looks, 200000, 2)) @ np.array([1, 1j]) / np.sqrt(2)
    fields[1] = alike * fields[0] + np.sqrt(1 - alike**2) * fields[1]
    power = (np.abs(fields) ** 2).mean(axis=1)
    greys = np.interp(10 * np.log10(power) - 2, BENT.power_db, BENT.greys)
    found = displayed_speckle.coefficients(BENT, -2.0, looks)
    terms = found[1:] ** 2
    assert found[0] == pytest.approx(greys.mean(), abs=0.01 * greys.std())
    assert np.sqrt(terms.sum()) == pytest.approx(greys.std(), rel=0.01)
    expected = (terms * alike ** (2 * np.arange(1, len(terms) + 1))).sum() / terms.sum()
    assert np.corrcoef(greys)[0, 1] == pytest.approx(expected, abs=0.01)


def test_one_look_is_spences_function():
    alike = np.linspace(0, 0.98, 15)
    assert np.allclose(displayed_speckle.grey_correlation(alike, 1.0), speckle.grey_correlation(alike), atol=0.01)


@pytest.mark.parametrize("line_mm", [0.0, 0.3, 0.6])
def test_lines_between_interpolated_columns_are_counted(line_mm):
    """159 columns' distances are shared evenly by a whole number of lines, whose places are rounded."""
    array = Transducer(image_size=(160, 408), picture=Picture(line_mm=line_mm))
    found = displayed_speckle.line_spacing_px(scanner_draws.recorded(array, 0.5, 3, places=3, steps=0).tissue)
    if line_mm == 0:
        assert found is None
    else:
        assert found == pytest.approx(159 / round(159 * 0.1229 / line_mm), rel=0.01)


def test_a_recorded_scanner_has_lines_every_fifth_of_a_millimetre(real):
    """192 lines over 38 mm, in both halves of the sweep."""
    images = sequences.read_sequence(real / "tracked_sweep/SpinePhantomFreehand.igs.mha").images[:, 12:602, 188:632]
    for half in (images[:10], images[11:]):
        assert 0.0854 * displayed_speckle.line_spacing_px(half) == pytest.approx(0.2, abs=0.005)


def test_grains_of_raw_speckle_are_as_wide_as_their_field_says(rng):
    """Of 12 B-scans of a Gaussian field: widths by Spence's function, contrast by 5.57 dB; within 4 sigma and 2 %."""
    images, s = speckle_captures.speckle(12, -22.0, rng, grain_px=2.0), 2.0
    found = displayed_speckle.summary(images, (0.12, 0.12)).estimates
    lags = np.linspace(0, 8, 4001)
    grey = speckle.grey_correlation(np.exp(-(lags**2) / (4 * s**2)))
    half = 2 * 0.12 * lags[np.argmin(np.abs(grey - 0.5))]
    contrast = speckle.SPREAD_DB * speckle_captures.GREYS_A_DB / images.mean()
    for name, true, rounding in (("deep_mm", half, 0.02 * half), ("along_mm", half, 0.02 * half), ("contrast", contrast, 0.0)):
        one = found[f"speckle.{name}"]
        assert abs(one.value - true) < 4 * one.sigma + rounding and one.sigma < 0.03 * true, name
    assert "ultrasound.picture.line_mm" not in found
