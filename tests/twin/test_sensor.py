"""The sensor against EMVA 1288: photon transfer, dark noise, fixed pattern, clipping; and its determinism."""

import numpy as np
import pytest
from scipy import stats

from recon.errors import InputError
from twin.sensor import (
    SMOOTHING_E,
    Exposure,
    auto_exposure,
    digitise,
    electrons_per_radiance,
    expose,
    fixed_pattern,
    noise_dn,
    read_out,
)

WAVELENGTH = 525.0


def shots(device, radiance: float, count: int = 40, bits: int = 10, seed: int = 1) -> np.ndarray:
    images = np.full((count, 64, 64), radiance, np.float32)
    return expose(images, device, WAVELENGTH, Exposure(0.01, 1.0, bits), seed).astype(float)


def radiance_for(device, electrons: float) -> float:
    return electrons / electrons_per_radiance(device, WAVELENGTH) / 0.01


def test_electrons_by_hand(rig):
    """Photons on a pixel by the formula of a thin lens, photon by photon."""
    device = rig.cam1
    image_distance = 3320 * 4.8e-3
    irradiance = np.pi / 4 * (16 / device.lens.f_number / image_distance) ** 2  # W/mm^2 for 1 W/mm^2/sr
    photons = irradiance * 4.8e-3**2 / (6.62607015e-34 * 299792458 / 525e-9)
    assert electrons_per_radiance(device, WAVELENGTH) == pytest.approx(photons * device.sensor.quantum_efficiency, rel=1e-6)


@pytest.mark.parametrize("electrons", [0, 500, 3000, 6000])
def test_temporal_noise_is_predicted(rig, electrons):
    """The variance over 40 images of one scene is the model's, from the dark to near saturation (5 standard errors)."""
    images = shots(rig.cam1, radiance_for(rig.cam1, electrons))
    dark = rig.cam1.sensor.dark_current_e_per_s * 0.01
    predicted = noise_dn(np.float32(electrons + dark), rig.cam1.sensor, Exposure(0.01, 1.0, 10)) ** 2
    variance = images.var(axis=0, ddof=1).mean()
    assert variance == pytest.approx(
        predicted, rel=5 * np.sqrt(2 / (39 * 64 * 64)) + 0.005
    )  # 0.5 %: rounding is not quite uniform


def test_spatial_noise(rig):
    """Averaged over time, pixels differ by DSNU in the dark and by PRNU in the light."""
    sensor = rig.cam1.sensor
    scale = (1024 - 4 * sensor.black_level_dn) / sensor.saturation_e
    dark = shots(rig.cam1, 0.0).mean(axis=0)
    light = shots(rig.cam1, radiance_for(rig.cam1, 4000)).mean(axis=0)
    assert dark.std() == pytest.approx(sensor.dsnu_e * scale, rel=0.15)
    assert (light - dark).std() == pytest.approx(np.hypot(4000 * sensor.prnu, np.sqrt(4000 / 40)) * scale, rel=0.1)


def test_response_is_linear(rig):
    """Twice the light gives twice the signal above the dark."""
    dark, one, two = (shots(rig.cam1, radiance_for(rig.cam1, e)).mean() for e in (0, 1500, 3000))
    assert (two - dark) / (one - dark) == pytest.approx(2, rel=0.005)


def test_clipping(rig):
    """Too much light fills the range and no more; less than nothing is zero."""
    assert shots(rig.cam1, radiance_for(rig.cam1, 1e5), count=1, bits=8).min() == 255
    assert digitise(np.full((2, 2), -1e4, np.float32), rig.cam1.sensor, Exposure(0.01)).max() == 0


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (10, np.uint16)])
def test_bits(rig, bits, dtype):
    """The image has the bits that are asked for: the ADC's most significant ones."""
    images = np.full((1, 8, 8), radiance_for(rig.cam1, 5000), np.float32)
    numbers = expose(images, rig.cam1, WAVELENGTH, Exposure(0.01, 1.0, bits), seed=1)
    assert numbers.dtype == dtype
    assert 0.55 < numbers.mean() / 2**bits < 0.75


def test_auto_exposure(rig, rng):
    """The brightest image's bright end comes to the level that is asked for."""
    radiance = np.float32(rng.uniform(0, 3e-7, (3, 128, 128)))
    time_s = auto_exposure(radiance, rig.cam1, WAVELENGTH, level=0.8, percentile=99)
    images = expose(radiance, rig.cam1, WAVELENGTH, Exposure(time_s), seed=1)
    assert np.percentile(images, 99) / 255 == pytest.approx(0.8, abs=0.03)


def test_a_small_spot_in_the_dark_is_exposed_for(rig):
    """Less than the percentile leaves, and between the pixels that count: its peak comes to the level, instead of 1 s."""
    radiance = np.zeros((2, 64, 64), np.float32)
    radiance[1, 21:23, 21:23] = 2e-7
    images = expose(radiance, rig.cam1, WAVELENGTH, Exposure(auto_exposure(radiance, rig.cam1, WAVELENGTH, level=0.8)), seed=1)
    assert images[1, 21:23, 21:23].mean() / 255 == pytest.approx(0.8, abs=0.05)
    assert auto_exposure(0 * radiance, rig.cam1, WAVELENGTH) == 1.0


def test_settings_that_no_shot_has_are_refused(rig):
    """Twelve bits of a ten-bit ADC were shifted the wrong way before."""
    for wrong, named in (((-1.0,), "time_s"), ((float("nan"),), "time_s"), ((0.01, 0.0), "gain"), ((0.01, 1.0, 9), "bits")):
        with pytest.raises(InputError, match=f"exposure: {named}: expected"):
            Exposure(*wrong)
    with pytest.raises(InputError, match="bits: expected at most the 10 of the sensor's ADC, found 12"):
        shots(rig.cam1, 1e-7, count=1, bits=12)
    with pytest.raises(InputError, match="bits: expected at most the 10 of the sensor's ADC, found 12"):
        digitise(np.zeros((2, 2), np.float32), rig.cam1.sensor, Exposure(0.01, bits=12))


def test_seed_decides_and_cameras_differ(rig):
    """The same seed gives the same bytes; another seed other noise; another camera another fixed pattern."""
    first, again, other = (shots(rig.cam1, 1e-7, 2, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.5
    assert (first[0] != first[1]).mean() > 0.5
    assert rig.cam1.serial != rig.cam2.serial
    response = [fixed_pattern(camera.sensor, (64, 64), camera.serial)[0].ravel() for camera in (rig.cam1, rig.cam2)]
    assert np.corrcoef(*response)[0, 1] < 0.1


@pytest.mark.parametrize("dark_noise", [SMOOTHING_E, 11.0])
@pytest.mark.parametrize("electrons", [0.0, 3.0, 30.0, 300.0, 6000.0])
def test_noise_drawn_in_one_is_shot_and_dark_noise(rng, electrons, dark_noise):
    """Mean, variance, skewness and kurtosis are those of a Poisson number plus a normal one, and so is the distribution."""
    count = 250_000
    drawn = read_out(np.full((1000, count // 1000), electrons, np.float32), dark_noise, rng).ravel().astype(float)
    variance = electrons + dark_noise**2
    z = (drawn - electrons) / np.sqrt(variance)
    assert abs(z.mean()) < 5 / np.sqrt(count)
    assert abs(z.var() - 1) < 5 * np.sqrt(2 / count)
    assert abs(stats.skew(z) - electrons / variance**1.5) < 5 * np.sqrt(6 / count)
    assert abs(stats.kurtosis(z) - electrons / variance**2) < 5 * np.sqrt(24 / count)
    apart = rng.poisson(electrons, count) + dark_noise * rng.standard_normal(count)
    assert stats.ks_2samp(drawn, apart).pvalue > 1e-4


@pytest.mark.parametrize("bits", [8, 10])
def test_one_pass_is_the_chain_of_its_steps(rig, rng, bits):
    """Exposure, shot and dark noise, fixed pattern and ADC in one compiled pass give the numbers of one step after the other."""
    device, sensor, exposure = rig.cam1, rig.cam1.sensor, Exposure(0.01, 1.0, bits)
    radiance = np.float32(rng.uniform(-1e-8, 7e-7, (2, 40, 50)))
    assert sensor.dark_noise_e >= SMOOTHING_E
    response, offset = fixed_pattern(sensor, (40, 50), device.serial)
    scale = np.float32(electrons_per_radiance(device, WAVELENGTH) * exposure.time_s)
    dark = np.float32(sensor.dark_current_e_per_s * exposure.time_s)
    images = expose(radiance, device, WAVELENGTH, exposure, seed=4)
    for image, light, stream in zip(images, radiance, np.random.SeedSequence(4).spawn(2), strict=True):
        electrons = read_out(np.maximum(light * scale * response, 0) + dark, sensor.dark_noise_e, np.random.default_rng(stream))
        np.testing.assert_array_equal(image, digitise(electrons + offset, sensor, exposure))


def test_single_electrons_are_counted_where_dark_noise_is_low(rng):
    """A sensor without dark noise reads whole electrons, and none in the dark."""
    drawn = read_out(np.full((100, 100), 2.0, np.float32), 0.0, rng)
    np.testing.assert_array_equal(drawn, np.rint(drawn))
    assert abs((drawn == 0).mean() - np.exp(-2)) < 5 * np.sqrt(np.exp(-2) / 10**4)
