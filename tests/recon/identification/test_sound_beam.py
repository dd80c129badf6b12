"""Closed forms of the beam beside the twin's tables, and beside Huygens' sum."""

import numpy as np
import pytest

from recon.identification import sound_beam
from recon.identification.sound_beam import Across, Along
from twin.experiments.bmode_accuracy import lens_correlation
from twin.ultrasound.beam import STEP_MM, beam
from twin.ultrasound.transducer import Transducer


def alike(field, lag):
    """Correlation of a table with itself, some steps on."""
    return abs(np.vdot(field[:-lag], field[lag:])) / np.vdot(field, field).real


@pytest.mark.parametrize("depth", [6.0, 16.0, 25.0, 42.0])
def test_grains_along_the_array_are_those_of_the_twin(depth):
    """To 0.005, of a table that ends 54 dB under its top."""
    array = Transducer()
    mine = Along(array.wavelength_mm, array.transmit_focus_mm, array.transmit_f_number, array.receive_f_number, array.aperture_mm)
    pitch, row = array.scale_mm_per_px[0], round(depth / array.scale_mm_per_px[1])
    table, lags = beam(array).lateral[row], np.arange(1, 6)
    found = sound_beam.alike_along(mine, row * array.scale_mm_per_px[1])(pitch * lags)
    assert np.allclose(found, [alike(table, lag) for lag in lags], atol=0.005)


@pytest.mark.parametrize("depth", [8.0, 15.0, 22.0, 40.0])
def test_grains_across_the_plane_are_those_of_the_twin_and_of_huygens(depth):
    array = Transducer()
    slab, steps = Across(array.wavelength_mm, array.elevation_mm, array.elevation_focus_mm), np.array([0.2, 0.4, 0.6])
    near, far = array.bandwidth
    found = sound_beam.alike_across(slab, depth, steps, near + (far - near) * depth / array.depth_mm)
    half = beam(array).elevation[int(depth / 0.25)]
    table = np.concatenate([half[:0:-1], half])
    assert np.allclose(found, [alike(table, round(step / STEP_MM)) for step in steps], atol=0.01)
    assert np.allclose(found, [lens_correlation(array, depth, step) for step in steps], atol=0.05)


def test_interpolated_echoes_have_longer_grains(rng):
    """White noise of 20000 lines, each shared by two neighbours at a place between: the correlation's error is 0.007; 4 pass."""
    white, place = rng.standard_normal(20001), rng.uniform(0, 1, 20001)
    field = np.zeros(20001)
    np.add.at(field, np.arange(20000), ((1 - place) * white)[:20000])
    np.add.at(field, np.arange(1, 20001), (place * white)[:20000])
    found = (field[1:] * field[:-1]).mean() / (field**2).mean()
    expected = sound_beam.interpolated(lambda lag: np.float64(np.abs(lag) < 0.5), np.array([1.0]), 1.0, 1 / 6)
    assert found == pytest.approx(float(expected[0]), abs=0.028)
