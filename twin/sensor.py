"""An image sensor by the EMVA 1288 model: photons, electrons, digital numbers.

Photons arrive as a Poisson process and free electrons with the quantum efficiency; dark current adds more; each pixel has its
own response (PRNU) and dark signal (DSNU); reading adds dark noise; gain, black level, clipping and the ADC make a number.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.constants import c as LIGHT_SPEED
from scipy.constants import h as PLANCK

from recon.compiled import kernel, njit
from recon.errors import InputError
from recon.model.rig import CameraDevice, Sensor
from recon.threads import mapped

SMOOTHING_E = 4.0  # dark noise that leaves nothing of the steps of single electrons, and a skewness below 0.1 at any mean

Images = NDArray[np.float32]
Numbers = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True)
class Exposure:
    """Settings of a shot.

    Raises
    ------
    InputError
        If one is out of its range.
    """

    time_s: float
    gain: float = 1.0  # 1 fills the ADC's range with `saturation_e` electrons
    bits: Literal[8, 10, 12] = 8  # of the image; at most the ADC's, see `dropped_bits`

    def __post_init__(self) -> None:
        if not 0 <= self.time_s < np.inf:
            raise InputError(f"exposure: time_s: expected a time from 0, found {self.time_s:g}")
        if not 0 < self.gain < np.inf:
            raise InputError(f"exposure: gain: expected more than 0, found {self.gain:g}; it is linear, not in dB")
        if self.bits not in (8, 10, 12):
            raise InputError(f"exposure: bits: expected 8, 10 or 12, found {self.bits}")


def electrons_per_radiance(device: CameraDevice, wavelength_nm: float) -> float:
    """Electrons a second that a radiance of 1 W/mm^2/sr on the axis frees in one pixel.

    The exit pupil of diameter D at the image distance v = focal_px * pixel gives the irradiance `pi/4 (D/v)^2 L`.
    """
    pixel_mm = device.sensor.pixel_um * 1e-3
    image_distance = device.optics.focal_px[0] * pixel_mm
    power = np.pi / 4 * (device.lens.aperture_mm / image_distance) ** 2 * pixel_mm**2
    return float(power * wavelength_nm * 1e-9 / (PLANCK * LIGHT_SPEED) * device.sensor.quantum_efficiency)


def auto_exposure(
    radiance: Iterable[Images], device: CameraDevice, wavelength_nm: float, *, level: float = 0.9, percentile: float = 99.9
) -> float:
    """Exposure time in s, to the microsecond, that brings the brightest image's percentile to a level of full scale at gain 1.

    Each fourth pixel along rows and columns counts; where too few are lit for the percentile, the brightest pixel does.

    radiance : (n, h, w), W/mm^2/sr. A scene without light gets 1 s.
    """
    brightest, peak = 0.0, 0.0
    for image in radiance:
        brightest = max(brightest, float(np.percentile(image[::4, ::4], percentile)))
        if not brightest:
            peak = max(peak, float(image.max()))
    brightest = brightest or peak
    if brightest <= 0:
        return 1.0
    seconds = level * device.sensor.saturation_e / (brightest * electrons_per_radiance(device, wavelength_nm))
    return max(round(seconds, 6), 1e-6)


class Stack(Protocol):
    """Images : (n, h, w) float32, an array or made one by one."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Their number, height and width."""
        ...

    def __getitem__(self, k: int) -> Images: ...


class Readout(NamedTuple):
    """From radiance to digital numbers, for one sensor and exposure."""

    scale: np.float32  # electrons a radiance
    dark_e: np.float32  # electrons of the dark current
    dark_variance: np.float32  # electrons^2, of the dark noise
    gain: np.float32  # numbers of the ADC an electron
    black: np.float32  # numbers of the ADC
    brightest: np.float32  # number of the ADC
    dropped: int  # least significant bits that the image leaves out


def expose(radiance: Stack, device: CameraDevice, wavelength_nm: float, exposure: Exposure, seed: int) -> Numbers:
    """Take images.

    Parameters
    ----------
    radiance : (n, h, w) float32, W/mm^2/sr
        What the renderer says arrives at each pixel.
    seed : int
        Of the temporal noise; image k has its own stream, whatever the number of threads. PRNU and DSNU come from the camera's
        serial number: they are the same in every image and every capture.

    Returns
    -------
    (n, h, w) uint8, or uint16 for more than 8 bits
    """
    sensor, (count, *shape) = device.sensor, radiance.shape
    response, offset = fixed_pattern(sensor, tuple(shape), device.serial)
    readout = readout_of(device, wavelength_nm, exposure)
    numbers = np.empty((count, *shape), np.uint8 if exposure.bits == 8 else np.uint16)

    def one(k: int, stream: np.random.SeedSequence) -> None:
        numbers[k] = sensed(radiance[k], (response, offset), readout, sensor, exposure, np.random.default_rng(stream))

    list(mapped(one, range(count), np.random.SeedSequence(seed).spawn(count)))
    return numbers


def sensed(
    radiance: Images,
    pattern: tuple[Images, Images],
    readout: Readout,
    sensor: Sensor,
    exposure: Exposure,
    generator: np.random.Generator,
) -> Numbers:
    """Take one image : (h, w), with the fixed pattern's response and offset."""
    response, offset = pattern
    if sensor.dark_noise_e >= SMOOTHING_E:
        numbers = np.empty(radiance.shape, np.uint8 if exposure.bits == 8 else np.uint16)
        _take(radiance, generator.standard_normal(radiance.shape, np.float32), response, offset, readout, numbers)
        return numbers
    mean = np.maximum(radiance * readout.scale * response, 0) + readout.dark_e
    return digitise(read_out(mean, sensor.dark_noise_e, generator) + offset, sensor, exposure)


def dropped_bits(sensor: Sensor, exposure: Exposure) -> int:
    """Least significant bits of the ADC that an image leaves out; raises InputError if the image has more than the ADC."""
    if exposure.bits > sensor.adc_bits:
        raise InputError(f"exposure: bits: expected at most the {sensor.adc_bits} of the sensor's ADC, found {exposure.bits}")
    return sensor.adc_bits - exposure.bits


def readout_of(device: CameraDevice, wavelength_nm: float, exposure: Exposure) -> Readout:
    """Of a camera."""
    scale = electrons_per_radiance(device, wavelength_nm) * exposure.time_s
    return readout_by(device.sensor, exposure, scale, device.sensor.dark_current_e_per_s * exposure.time_s)


def readout_by(sensor: Sensor, exposure: Exposure, scale: float, dark_e: float = 0.0) -> Readout:
    """Of a sensor, by the electrons of a radiance of 1 and those of the dark current."""
    dropped = dropped_bits(sensor, exposure)
    return Readout(
        np.float32(scale),
        np.float32(dark_e),
        np.float32(sensor.dark_noise_e**2),
        np.float32(number_per_electron(sensor, exposure) * 2**dropped),
        np.float32(sensor.black_level_dn * 2 ** (sensor.adc_bits - 8)),
        np.float32(2**sensor.adc_bits - 1),
        dropped,
    )


@kernel
def _take(radiance, normal, response, offset, readout, numbers):
    """One image by `read_out` and `digitise` in one pass, with the noise from standard normal numbers."""
    for i in range(radiance.shape[0]):
        for j in range(radiance.shape[1]):
            mean = max(radiance[i, j] * readout.scale * response[i, j], np.float32(0)) + readout.dark_e
            electrons = np.float32(_drawn(mean, normal[i, j], readout.dark_variance)) + offset[i, j]
            count = np.rint(readout.black + electrons * readout.gain)
            numbers[i, j] = np.uint16(min(max(count, np.float32(0)), readout.brightest)) >> readout.dropped


def read_out(mean: Images, dark_noise_e: float, generator: np.random.Generator) -> Images:
    """Draw the electrons that are read, by shot noise and dark noise, for mean numbers of electrons : (h, w) float32.

    Where dark noise hides that electrons are whole, both noises are drawn in one, from a normal variable that is bent until mean,
    variance, skewness and kurtosis are those of the sum: four times faster, and no test of 10^6 draws tells them apart.
    """
    if dark_noise_e >= SMOOTHING_E:
        normal = generator.standard_normal(mean.shape, np.float32)
        return _bent(mean, normal, np.float32(dark_noise_e**2))
    electrons = generator.poisson(mean).astype(np.float32)
    return electrons + np.float32(dark_noise_e) * generator.standard_normal(mean.shape, np.float32)


@njit(inline="always")
def _drawn(mean, z, dark_variance):
    """Poisson of a mean plus normal noise, from a standard normal number, by the expansion of Cornish and Fisher (1938)."""
    variance = mean + dark_variance
    sigma = np.sqrt(variance)
    skewness, kurtosis = mean / (variance * sigma), mean / (variance * variance)
    bend = skewness / 6 * (z * z - 1)
    bend += z * (kurtosis / 24 * (z * z - 3) - skewness * skewness / 36 * (2 * z * z - 5))
    return mean + sigma * (z + bend)


@njit(nogil=True, error_model="numpy")
def _bent(mean, normal, dark_variance):
    """`_drawn` for each pixel : (h, w)."""
    result = np.empty_like(normal)
    for i in range(mean.shape[0]):
        for j in range(mean.shape[1]):
            result[i, j] = _drawn(mean[i, j], normal[i, j], dark_variance)
    return result


def fixed_pattern(sensor: Sensor, shape: tuple[int, ...], serial: int) -> tuple[Images, Images]:
    """Response (mean 1, PRNU) and offset in electrons (mean 0, DSNU) of each pixel : (h, w)."""
    generator = np.random.default_rng(serial)
    response = 1 + np.float32(sensor.prnu) * generator.standard_normal(shape, np.float32)
    return response, np.float32(sensor.dsnu_e) * generator.standard_normal(shape, np.float32)


def number_per_electron(sensor: Sensor, exposure: Exposure) -> float:
    """System gain: digital numbers of the image for one electron."""
    return exposure.gain * (2**exposure.bits - 2 ** (exposure.bits - 8) * sensor.black_level_dn) / sensor.saturation_e


def digitise(electrons: Images, sensor: Sensor, exposure: Exposure) -> Numbers:
    """Electrons to digital numbers: gain, black level, clipping, ADC, and the image's most significant bits."""
    dropped = dropped_bits(sensor, exposure)
    counts = sensor.black_level_dn * 2 ** (sensor.adc_bits - 8) + electrons * np.float32(
        number_per_electron(sensor, exposure) * 2**dropped
    )
    numbers = np.clip(np.rint(counts), 0, 2**sensor.adc_bits - 1).astype(np.uint16) >> dropped
    return numbers.astype(np.uint8) if exposure.bits == 8 else numbers


def noise_dn(electrons: Images, sensor: Sensor, exposure: Exposure) -> Images:
    """Temporal noise that the model predicts for a mean number of electrons : standard deviation in digital numbers."""
    return np.sqrt(number_per_electron(sensor, exposure) ** 2 * (electrons + sensor.dark_noise_e**2) + 1 / 12)  # 1/12: rounding
