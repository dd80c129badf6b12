"""Sound in water, and what a scanner makes of it."""

from dataclasses import replace

import numpy as np
import pytest

from recon.capture.probe_files import PARAMETERS
from recon.errors import InputError
from recon.freehand import sequences
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import ProbeCalibration
from recon.probe_calibration import sound_in_water


@pytest.mark.parametrize(
    ("temperature", "speed"), [(0, 1402.39), (20, 1482.34), (22, 1488.33), (25, 1496.69), (37, 1523.62), (74, 1555.15)]
)
def test_speeds_are_those_of_the_tables(temperature, speed):
    """Bilaniuk and Wong 1993, another fit to other measurements: within 0.1 m/s, at the maximum near 74 degrees too."""
    assert sound_in_water.speed_of_sound(temperature) == pytest.approx(speed, abs=0.1)


def test_the_sigma_is_that_of_neighbouring_temperatures():
    near = sound_in_water.speed_of_sound([21.5, 22.5])
    assert sound_in_water.speed_sigma(22.0, 0.5) == pytest.approx((near[1] - near[0]) / 2, rel=1e-3)


def test_water_seems_deeper_than_it_is():
    """An echo at 50 mm of water of 22 degrees: its delay, shown at half of 1540 m/s, is 1.74 mm too deep."""
    speed = sound_in_water.speed_of_sound(22.0)
    shown = (2 * 50.0 / speed) * sound_in_water.SCANNER_SPEED / 2
    assert shown - sound_in_water.shown_too_deep(shown, speed) == pytest.approx(50.0)
    assert shown - 50.0 == pytest.approx(1.74, abs=0.01)


@pytest.mark.parametrize("temperature", [-1, 96, np.nan])
def test_no_water_at_these_temperatures(temperature):
    with pytest.raises(InputError, match="temperature_c"):
        sound_in_water.speed_of_sound(temperature)


@pytest.fixture
def probe(rig, rng):
    root = rng.standard_normal((8, 8)) * np.array([1e-4, 1e-4, 1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1])[:, None]
    uncertainty = Uncertainty(PARAMETERS, root @ root.T)
    return ProbeCalibration(rig.probe.target_from_image.matrix(), np.array(rig.probe.scale_mm_per_px), uncertainty)


def test_the_face_keeps_its_place_and_depths_scale_about_it(probe):
    probe = replace(probe, face_row=12.0)
    made = sound_in_water.in_medium(probe, 1488.0, 1540.0)
    before, after = probe.to_target([[40, 12], [40, 112]]), made.to_target([[40, 12], [40, 112]])
    assert after[0] == pytest.approx(before[0])
    assert after[1] - after[0] == pytest.approx((before[1] - before[0]) * 1540 / 1488)


def test_there_and_back_is_where_it_was(probe):
    probe = replace(probe, face_row=12.0)
    back = sound_in_water.in_medium(sound_in_water.in_medium(probe, 1488.0, 1540.0), 1540.0, 1488.0)
    assert back.scale == pytest.approx(probe.scale) and back.speed_m_s == 1488.0
    assert back.target_from_image == pytest.approx(probe.target_from_image)
    assert back.uncertainty.covariance == pytest.approx(probe.uncertainty.covariance)


def test_the_covariance_goes_along(probe, rng):
    """Calibrations drawn from the covariance and converted scatter as the converted covariance says."""
    face, ratio_sigma = 40.0, 0.002
    probe = replace(probe, face_row=face)
    made = sound_in_water.in_medium(probe, 1488.0, 1540.0, ratio_sigma)
    placed = []
    for step in rng.multivariate_normal(np.zeros(8), probe.uncertainty.covariance, 3000):
        turn = rigid.from_rotation_vector(step[2:5], [0, 0, 0])[:3, :3] @ probe.target_from_image[:3, :3]
        shifted = rigid.transform(turn, probe.target_from_image[:3, 3] + step[5:])
        drawn = ProbeCalibration(shifted, probe.scale + step[:2], face_row=face)
        speed = 1540.0 + 1488.0 * ratio_sigma * rng.standard_normal()
        converted = sound_in_water.in_medium(drawn, 1488.0, speed)
        placed.append(np.concatenate([converted.scale, converted.target_from_image[:3, 3]]))
    kept = [0, 1, 5, 6, 7]
    sampled, predicted = np.cov(np.array(placed), rowvar=False), made.uncertainty.covariance[np.ix_(kept, kept)]
    sigma = np.sqrt(np.diag(predicted))
    assert np.abs((sampled - predicted) / np.outer(sigma, sigma)).max() < 0.1  # 4 sigma of 3000 draws


def test_a_speed_of_no_medium_is_refused(probe):
    with pytest.raises(InputError, match="calibrated"):
        sound_in_water.in_medium(probe, 1.488, 1540.0)


def test_matrices_and_calibrations_are_converted_alike(probe, rng):
    """From whatever speed a calibration holds for; and not at all where the tissue's isn't known."""
    in_water = sound_in_water.in_medium(probe, 1540.0, 1488.0)
    made = sound_in_water.for_tissue(in_water, 1450.0)
    assert made.scale[1] == pytest.approx(probe.scale[1] * 1450 / 1540) and made.speed_m_s == 1450.0
    assert sound_in_water.for_tissue(in_water, None) is in_water
    pixels = rng.uniform(0, 300, (20, 2))
    flat = np.column_stack([pixels, np.zeros(20)])
    cropped_above = replace(in_water, face_row=30.0)
    matrix = sound_in_water.in_tissue(sequences.target_from_pixel(cropped_above), in_water.speed_m_s, 1450.0, 30.0)
    alike = sequences.target_from_pixel(sound_in_water.for_tissue(cropped_above, 1450.0))
    assert matrix[:, [0, 1, 3]] == pytest.approx(alike[:, [0, 1, 3]])
    matrix = sound_in_water.in_tissue(sequences.target_from_pixel(in_water), in_water.speed_m_s, 1450.0)
    np.testing.assert_allclose(rigid.apply(matrix, flat), made.to_target(pixels), atol=1e-9)
    with pytest.raises(InputError, match="speed: expected a speed of sound of 300 to 5000 m/s, found nan"):
        sound_in_water.in_tissue(matrix, 1540.0, np.nan)


def test_a_thermometer_that_is_off_is_in_the_covariance(probe, rng):
    """Of a probe of which the scale in the water is known, and the water's temperature to 1 degree: errors over their sigma."""
    water, wanted, ratio = sound_in_water.speed_of_sound(22.0), 1540.0, []
    exact = ProbeCalibration(probe.target_from_image, probe.scale, Uncertainty(("sy",), np.zeros((1, 1))))
    sigma = sound_in_water.speed_sigma(22.0, 1.0)
    made = sound_in_water.in_medium(exact, water, wanted, ratio_sigma=wanted / water**2 * sigma)
    for true in 22.0 + rng.standard_normal(200):
        right = probe.scale[1] * wanted / sound_in_water.speed_of_sound(true)
        ratio.append((made.scale[1] - right) / made.uncertainty.sigma("sy"))
    assert 0.85 < np.std(ratio) < 1.15 and abs(np.mean(ratio)) < 0.25


def test_a_speed_of_tissue_that_is_uncertain_adds_to_that_of_depths(probe):
    """By 25 of 1540 m/s, beside what the calibration leaves; and alone, where that has no covariance."""
    made = sound_in_water.for_tissue(probe, 1540.0, 25.0)
    known = sound_in_water.for_tissue(probe, 1540.0)
    assert made.uncertainty.sigma("sy") == pytest.approx(np.hypot(known.uncertainty.sigma("sy"), 25 / 1540 * made.scale[1]))
    alone = sound_in_water.for_tissue(ProbeCalibration(probe.target_from_image, probe.scale), None, 25.0)
    assert alone.uncertainty.sigma("sy") == pytest.approx(25 / 1540 * probe.scale[1]) and alone.scale == pytest.approx(
        probe.scale
    )
