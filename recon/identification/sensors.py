"""A camera's sensor by the figures of EMVA 1288, from its dark frames, flat frames, fringes and codes.

Photon transfer gives the gain K in digital numbers (DN) an electron, dark frames the black level, dark noise and DSNU, flat
frames the PRNU. With `black` the black level, `K saturation_e = gain (2^bits - 2^(bits - 8) black_level_dn)`.

Images don't show: the quantum efficiency, as electrons are counted and the light's power isn't known; the bits of an ADC whose
lowest ones are dropped, which moves all values by up to half a DN, just as the black level does; and dark current in one
exposure, which adds to the black level and, like dark noise, to the variance. The latter two are counted as uncertainty.

Source: EMVA 1288, Release 4.0.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.identification.dark_frames import Interval, dark_moments, fit_dark
from recon.identification.estimates import Estimate, Findings
from recon.identification.photon_transfer import (
    PhotonTransfer,
    TileNoise,
    joined,
    noise_of_flat,
    noise_of_patterns,
    transfer_line,
)
from recon.identification.pixel_response import pixel_response
from recon.identification.raw_images import describe_drift, describe_processing
from recon.model.patterns import Patterns
from recon.model.rig import Sensor

Array = NDArray[np.float64]

FIELDS = (  # that images may show, or can't
    "saturation_e",
    "dark_noise_e",
    "dsnu_e",
    "prnu",
    "black_level_dn",
    "quantum_efficiency",
    "adc_bits",
    "dark_current_e_per_s",
)
NOT_RAW = "images aren't raw"
NOISE = "noise_at_zero_dn2."  # of a camera: its line of variance over level, 8-bit DN^2, at level 0
UNIFORM = 1 / np.sqrt(12)  # standard deviation of a range of 1
NO_LINE = PhotonTransfer(1.0, 0.0, np.diag([1e-12, 1e12]), 0.0, 0.0)  # without a gain, electrons stand for DN


@dataclass(frozen=True)
class SensorLimits:
    """What is taken for granted of a sensor, and when a figure counts as measured."""

    dark_current_e_per_s: float = 1000.0  # at most, of a warm camera; where dark frames of two exposures don't measure it
    saturation_e: float = 8000.0  # at least; where no gain is measured, for what dark current adds to the black level
    exposure_s: float = 1 / 30  # at most, where it isn't known
    black_level_dn: float = 16.0  # at most, 8-bit; where no dark frames measure it
    gain: float = 0.2  # relative standard deviation of K, at most
    dark: float = 0.3  # of dark noise and DSNU, at most; a DSNU is known as well where it is surely less than the noise
    dark_noise_e: float = 40.0  # at most; where no dark frames measure it
    one_value: float = 0.3  # DN, scatter of dark frames that show one value: the black level lies anywhere within its step
    coarse: float = 0.5  # DN of dark noise, under which the steps of the image hide most of it:
    shape: float = 0.025  # relative error of a DSNU then, by noise that isn't normal, such as the few electrons' of dark current


LIMITS = SensorLimits()


@dataclass(frozen=True)
class ImageSettings:
    """With which all images of a sensor were taken."""

    bits: int  # of the images
    gain: float | None = None  # linear; None: taken as 1
    adc_bits: int | None = None  # by the data sheet, if at hand
    processed: bool = False  # images that aren't raw count all the same

    @property
    def step(self) -> tuple[float, float]:
        """By which a value begins below itself, DN, and its standard deviation: half a step of the ADC.

        An unknown ADC has as many bits as the image, or two or four more, any alike.
        """
        steps = [0.5 ** (more + 1) for more in ((0, 2, 4) if self.adc_bits is None else (self.adc_bits - self.bits,))]
        return float(np.mean(steps)), float(np.std(steps))


class DarkStack(NamedTuple):
    """Frames without light, of one exposure."""

    frames: NDArray  # (n, h, w), n >= 2
    exposure_s: float | None = None


class PatternStack(NamedTuple):
    """A sequence of patterns on any steady scene."""

    images: NDArray  # (n, h, w), one an image of the sequence
    patterns: Patterns


def identify_sensor(
    camera: str,
    settings: ImageSettings,
    *,
    dark: Sequence[DarkStack] = (),
    flats: Sequence[NDArray] = (),
    sequences: Sequence[PatternStack] = (),
) -> Findings:
    """Measure a sensor.

    Parameters
    ----------
    camera : str
        Its name in the rig, such as `cam1`.
    dark : DarkStack
        The shortest exposure gives the figures, the longest the dark current.
    flats : (m, h, w) each, m >= 2
        Frames of one steady, smooth light; best of two levels or more, with some hundreds of electrons at least.
    sequences : PatternStack
        With eight steps of fringes or more, an even number of binary ones, or a code and its inverses.

    Returns
    -------
    Findings
        `CAMERA.sensor.FIELD` for all fields but the pixel's size. Of images that aren't raw no field is known.
    """
    n = camera + ".sensor."
    by_flats = joined(noise_of_flat(frames, settings.bits) for frames in flats)
    by_patterns = joined(noise_of_patterns(stack.images, stack.patterns, settings.bits) for stack in sequences)
    processing = None if settings.processed else describe_drift(flats) or _processing(by_flats, by_patterns)
    if processing is not None:
        return without_raw_images(camera, processing)
    # Fringes of a scene leave some tenths of a per cent in the variance, which many flat frames would be known better than.
    noise = by_patterns if by_flats is None else by_flats
    line, seen = (None, "") if noise is None else (transfer_line(noise), _names(settings, flats, sequences))
    unknown = {
        n + "quantum_efficiency": "images count electrons; the light's power on a pixel isn't known, so photons aren't",
        n + "adc_bits": f"images of {settings.bits} bits leave out what the ADC has below them: see the data sheet",
        n + "dark_current_e_per_s": "needs dark frames of two exposures, and a gain",
    }
    if line is None:
        patterns = "eight steps of fringes, an even number of binary ones, or a code with its inverses"
        noise = "a noise of 0.6 DN or more (JPEG and denoising leave less)"
        why = f"needs flat frames, or {patterns}, with {noise}, at several levels or with dark frames"
        unknown |= dict.fromkeys((n + "saturation_e", n + "prnu"), why)
    found = Findings({}, unknown)
    stacks = sorted(dark, key=lambda stack: stack.exposure_s or 0.0)
    if stacks:
        found |= _from_dark(n, settings, line, (stacks[0], stacks[-1]), seen, flats)
    else:
        found |= _without_dark(n, settings, line, seen, flats)
    return found


def without_raw_images(camera: str, why: str) -> Findings:
    """No field of a sensor, whose images aren't what it measured."""
    return Findings({}, {f"{camera}.sensor.{name}": f"{NOT_RAW}: {why}" for name in FIELDS})


def without_light(black_level: Estimate, settings: ImageSettings) -> Estimate:
    """Mean, DN, that an image shows of a pixel without light, by the black level in 8-bit DN.

    Bits that an image leaves out are cut off, not rounded: 0.38 and 0.47 DN less in images of 8 bits by ADCs of 10 and 12.
    """
    deeper = 2.0 ** (settings.bits - 8)
    return Estimate(deeper * black_level.value - (0.5 - settings.step[0]), deeper * black_level.sigma, black_level.source)


def with_noise_as_seen(sensor: Sensor, camera: str, settings: ImageSettings, found: Findings) -> Sensor:
    """A sensor whose dark noise and black level are known together only, so that its noise is the one that was seen.

    The black level stays as it is assumed, and the dark noise makes up for it; where that can't be, there is none, and the black
    level is what it must be.
    """
    if NOISE + camera not in found.estimates:
        return sensor
    full, cut_off = 2.0 ** (settings.bits - 8), 0.5 - settings.step[0]
    gain, at_zero = _range(settings, sensor.black_level_dn) / sensor.saturation_e, found.estimates[NOISE + camera].value * full**2
    dark = at_zero + gain * (full * sensor.black_level_dn - cut_off)
    black = sensor.black_level_dn if dark >= 0 else (cut_off - at_zero / gain) / full
    return sensor.model_copy(update={"dark_noise_e": float(np.sqrt(max(dark, 0.0)) / gain), "black_level_dn": float(black)})


def _range(settings: ImageSettings, black_level_dn: float) -> float:
    """Digital numbers that `saturation_e` fills, times the camera's gain."""
    gain = 1.0 if settings.gain is None else settings.gain
    return gain * 2.0 ** (settings.bits - 8) * (256 - black_level_dn)


def _processing(by_flats: TileNoise | None, by_patterns: TileNoise | None) -> str | None:
    """What was done to the images, in words, by noise of flat frames or of patterns."""
    for noise, flat in ((by_flats, True), (by_patterns, False)):
        why = None if noise is None else describe_processing(noise, transfer_line(noise), by_flats=flat)
        if why is not None:
            return why
    return None


def _names(settings: ImageSettings, flats: Sequence[NDArray], sequences: Sequence[PatternStack]) -> str:
    """Of the images by which a line was found."""
    patterns = f"{sum(len(stack.images) for stack in sequences)} images of patterns"
    gain = " at gain 1, as the camera's isn't known" if settings.gain is None else ""
    gain += " taken for raw ones" if settings.processed else ""
    return (f"{sum(map(len, flats))} flat frames" if flats else patterns) + gain


def _without_dark(n: str, settings: ImageSettings, line: PhotonTransfer | None, seen: str, flats: Sequence[NDArray]) -> Findings:
    """From the line alone: the gain is known, black level and dark noise only together."""
    why = "needs dark frames"
    if line is None or line.gain < 1 / LIMITS.gain * np.sqrt(line.covariance[0, 0]):
        return Findings({}, dict.fromkeys((n + "black_level_dn", n + "dark_noise_e", n + "dsnu_e", n + "saturation_e"), why))
    full = 2.0 ** (settings.bits - 8)
    noiseless = -line.intercept / line.gain  # the level at which the line has no variance: black, but for dark noise
    high = max(min(line.darkest, LIMITS.black_level_dn * full, noiseless + line.gain * LIMITS.dark_noise_e**2), 0.0)
    low = min(max(noiseless, 0.0), high)
    least, most = (np.sqrt(max(end - noiseless, 0.0) / line.gain) for end in (low, high))  # dark noise in between, any alike
    noise = least + (most - least) * (np.arange(100) + 0.5) / 100
    sigma = [line.gain * (noise**2).std(), settings.step[1], np.sqrt(line.covariance[1, 1]) / line.gain]
    black = float(noiseless + line.gain * (noise**2).mean()), float(np.linalg.norm(sigma))
    together = (
        f"{why}: K^2 dark_noise_e^2 - K black = {line.intercept:.3g} +- {np.sqrt(line.covariance[1, 1]):.1g} DN^2 is known, "
        f"with K = {line.gain:.4g} DN an electron; black is between {low / full:.1f} and {high / full:.1f} DN of 8 bits"
    )
    unknown = {n + "black_level_dn": together, n + "dark_noise_e": together, n + "dsnu_e": why}
    gain = line.gain, float(np.sqrt(line.covariance[0, 0]))
    at_zero = Estimate(line.intercept / full**2, float(np.sqrt(line.covariance[1, 1])) / full**2, seen)
    found = Findings(
        {n + "saturation_e": _saturation(settings, gain, black, seen), NOISE + n.partition(".")[0]: at_zero}, unknown
    )
    return found | _prnu(n, settings, line, flats, black, None)


def _from_dark(
    n: str,
    settings: ImageSettings,
    line: PhotonTransfer | None,
    stacks: tuple[DarkStack, DarkStack],
    seen: str,
    flats: Sequence[NDArray],
) -> Findings:
    """From dark frames of the shortest and the longest exposure, and the line."""
    full, (step, step_sigma) = 2.0 ** (settings.bits - 8), settings.step
    times = [stack.exposure_s for stack in stacks]
    fits = [fit_dark(dark_moments(stack.frames), line or NO_LINE, step) for stack in stacks]
    fit, gain = fits[0], fits[0].gain.value
    source = f"{len(stacks[0].frames)} dark frames"
    found = Findings()
    cut_off, current = 0.5 - step, None
    if line and times[0] is not None and times[1] is not None and times[1] > times[0]:
        a_second = 1 / (gain * (times[1] - times[0]))
        current = max((fits[1].black.value - fits[0].black.value) * a_second, 0.0)
        sigma = float(np.hypot(fits[0].black.sigma, fits[1].black.sigma) * a_second + current * fit.gain.sigma / gain)
        both = f"dark frames of {times[0]:g} and {times[1]:g} s"
        found |= Findings({n + "dark_current_e_per_s": Estimate(current, sigma, both)})
        dark_e, dark_sigma = current * times[0], sigma * times[0]
    else:
        most = LIMITS.dark_current_e_per_s * (LIMITS.exposure_s if times[0] is None else times[0])
        most = min(most, fit.noise.high**2) if line else most
        dark_e, dark_sigma = most / 2, most * UNIFORM
    number = gain if line else _range(settings, 0) / LIMITS.saturation_e
    black = fit.black.value - number * dark_e
    hidden = UNIFORM if float(np.std(stacks[0].frames)) < LIMITS.one_value else 0.0
    black_sigma = float(np.linalg.norm([fit.black.sigma, number * dark_sigma, step_sigma, hidden]))
    found |= Findings({n + "black_level_dn": Estimate(max(black / full, 0.0), black_sigma / full, source)})
    if line is None:
        by_names = {"dark_noise_e": fit.noise, "dsnu_e": fit.spread}
        why = "{:.3g} to {:.3g} DN; electrons need a gain, by flat frames or patterns"
        return found | Findings({}, {n + name: why.format(*range_dn) for name, range_dn in by_names.items()})
    both = f"{source} and {seen}"
    if fit.gain.sigma > LIMITS.gain * gain:
        return found | Findings(
            {}, dict.fromkeys((n + "saturation_e", n + "dark_noise_e", n + "dsnu_e"), "the gain isn't known well")
        )
    known = {"saturation_e": _saturation(settings, (gain, fit.gain.sigma), (black, black_sigma), both)}
    unknown = {}
    steps = "below {:.2g} e: dark frames hardly leave one value, and their steps hide it; take images of more bits or gain"
    if fit.noise.sigma < LIMITS.dark * fit.noise.value:
        square = max(fit.noise.value**2 - dark_e, 0.0)
        noise = float(np.sqrt(square))
        sigma = float(np.hypot(fit.noise.sigma * fit.noise.value, dark_sigma / 2)) / max(noise, fit.noise.sigma)
        known["dark_noise_e"] = Estimate(noise, sigma, both)
    else:
        unknown["dark_noise_e"] = steps.format(fit.noise.high)
    if fit.spread.sigma < LIMITS.dark * fit.spread.value or fit.spread.high < fit.noise.low:
        shape = LIMITS.shape * fit.spread.value if gain * fit.noise.value < LIMITS.coarse else 0.0
        known["dsnu_e"] = Estimate(fit.spread.value, float(np.hypot(fit.spread.sigma, shape)), both)
    else:
        unknown["dsnu_e"] = steps.format(fit.spread.high)
    found |= Findings({n + name: one for name, one in known.items()}, {n + name: why for name, why in unknown.items()})
    pattern = None
    if np.isfinite(fit.spread.high):
        squares = Interval(*((gain * end) ** 2 for end in fit.spread))
        pattern = squares.value, squares.sigma
    return found | _prnu(n, settings, line, flats, (fit.black.value - cut_off, fit.black.sigma), pattern)


def _saturation(settings: ImageSettings, gain: tuple[float, float], black: tuple[float, float], source: str) -> Estimate:
    """Electrons that fill the range, by K and the black level in DN, each with its standard deviation."""
    filled = _range(settings, black[0] / 2.0 ** (settings.bits - 8))
    value = filled / gain[0]
    return Estimate(value, float(value * np.hypot(gain[1] / gain[0], black[1] / filled)), source)


def _prnu(
    n: str,
    settings: ImageSettings,
    line: PhotonTransfer,
    flats: Sequence[NDArray],
    black: tuple[float, float],
    dark: tuple[float, float] | None,
) -> Findings:
    """From flat frames; a scene's own texture can't be told from the pixels' response."""
    name = n + "prnu"
    if not flats:
        return Findings({}, {name: "needs flat frames: in fringes the scene's own texture looks like the pixels' response"})
    response = pixel_response(flats, settings.bits, line, black, dark)
    if response is None:
        return Findings(
            {}, {name: "needs dark frames, or flat frames of several levels, whose noise hides the steps of whole numbers"}
        )
    if response.textured:
        return Findings(
            {}, {name: f"at most {response.prnu.high:.2g}: the light has a fine pattern of its own; defocus, or a smoother one"}
        )
    return Findings({name: Estimate(response.prnu.value, response.prnu.sigma, f"{sum(map(len, flats))} flat frames")})
