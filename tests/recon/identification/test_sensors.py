"""A sensor's parameters from images of the twin's sensor: closed forms, coverage of the intervals, and a real recording."""

from dataclasses import dataclass
from typing import Literal, cast

import cv2
import numpy as np
import pytest
from scipy import stats

from recon.identification.dark_frames import dark_moments, expected_moments, fit_dark
from recon.identification.estimates import Estimate
from recon.identification.photon_transfer import PhotonTransfer, TileNoise, noise_of_fringes, noise_of_patterns, transfer_line
from recon.identification.sensors import (
    DarkStack,
    ImageSettings,
    PatternStack,
    identify_sensor,
    with_noise_as_seen,
    without_light,
)
from recon.model.patterns import Patterns
from recon.model.rig import Sensor
from twin.sensor import Exposure, Numbers, fixed_pattern, noise_dn, readout_by, sensed

SHAPE = 192, 256  # px: 192 tiles
FRAMES = 6
EXPOSURE_S = 1 / 60
CODE = {"kind": "gray", "pitch": 16, "bits": 4}
UNWRAPPED = {"projector_size": (256, 192), "unwrap": "gray"}
SEQUENCES = {
    "grey fringes": [{"kind": "fringes", "pitch": 16, "steps": 12}, CODE],
    "binary fringes": [{"kind": "fringes", "pitch": 16, "steps": 8, "origin": 7.5, "waveform": "binary"}, CODE],
    "inverses": [{"kind": "gray", "pitch": 4, "bits": 6, "inverted": True}],
}


@dataclass(frozen=True)
class Shots:
    """Images of one sensor."""

    sensor: Sensor
    settings: ImageSettings
    flicker: float  # relative
    generator: np.random.Generator

    def frames(self, electrons: list[np.ndarray], exposure_s: float = EXPOSURE_S) -> Numbers:
        """One image for each map of mean electrons : (h, w), without flicker."""
        sensor, exposure = self.sensor, Exposure(exposure_s, 1.0, cast(Literal[8, 10, 12], self.settings.bits))
        readout = readout_by(sensor, exposure, 1.0, sensor.dark_current_e_per_s * exposure_s)
        pattern = fixed_pattern(sensor, SHAPE, serial=5)
        return np.stack([sensed(np.float32(one), pattern, readout, sensor, exposure, self.generator) for one in electrons])

    def dark(self, exposure_s: float = EXPOSURE_S) -> DarkStack:
        return DarkStack(self.frames([np.zeros(SHAPE)] * FRAMES, exposure_s), exposure_s)

    def flat(self, share: float, texture: float = 0.0) -> Numbers:
        """Of saturation, under a lamp that is a quarter darker in the corners and flickers; on a board with a fine pattern."""
        y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
        lamp = 1 - 0.5 * ((x / SHAPE[1] - 0.4) ** 2 + (y / SHAPE[0] - 0.5) ** 2)
        pattern = cv2.GaussianBlur(self.generator.standard_normal(SHAPE), (0, 0), 1.0)
        board = share * self.sensor.saturation_e * lamp * (1 + texture * pattern / pattern.std())
        return self.frames([board * (1 + self.flicker * self.generator.standard_normal()) for _ in range(FRAMES)])

    def sequence(self, name: str) -> PatternStack:
        """Patterns of `SEQUENCES` by a projector with a gamma and a blur, each frame of another light; on stripes and shades."""
        patterns = Patterns.model_validate(UNWRAPPED | {"parts": SEQUENCES[name]})
        y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
        albedo = 0.55 + 0.35 * np.sin(x / 37 + y / 51) + 0.05 * np.sign(np.sin(y / 5))
        shown = np.concatenate([part.profiles(256) for part in patterns.parts]) ** 1.5
        light = [np.interp(x + y / 60, np.arange(256), cv2.GaussianBlur(row[None], (0, 0), 1.0)[0]) for row in shown]
        scale = 0.8 * self.sensor.saturation_e * (1 + self.flicker * self.generator.standard_normal(len(shown)))
        electrons = [a * albedo * (0.9 * one + 0.1) for a, one in zip(scale, light, strict=True)]
        return PatternStack(self.frames(electrons), patterns)


def drawn(seed: int) -> Shots:
    """A random sensor with random settings."""
    generator = np.random.default_rng([41, seed])
    adc_bits = int(generator.choice([8, 10, 12]))
    bits = int(generator.choice([bits for bits in (8, 10, 12) if bits <= adc_bits]))
    sensor = Sensor(
        pixel_um=4.8,
        quantum_efficiency=0.5,
        saturation_e=generator.uniform(3000, 60000),
        dark_noise_e=generator.uniform(1, 30),
        dark_current_e_per_s=generator.uniform(0, 1000),
        dsnu_e=generator.uniform(0, 20),
        prnu=generator.uniform(0.002, 0.02),
        black_level_dn=generator.uniform(0, 10),
        adc_bits=adc_bits,
    )
    return Shots(sensor, ImageSettings(bits, 1.0, adc_bits), generator.uniform(0, 0.02), generator)


@pytest.fixture
def shots(rig) -> Shots:
    """The rig's sensor, 8 of 10 bits, under a lamp that flickers by 1 %."""
    return Shots(rig.cam1.sensor, ImageSettings(8, 1.0, 10), 0.01, np.random.default_rng(8))


@pytest.mark.parametrize("black", [0.1, 3.3])
@pytest.mark.parametrize(("noise", "spread"), [(0.08, 0.3), (0.4, 0.2), (2.5, 1.0)])
@pytest.mark.parametrize("step", [0.5, 0.125])
def test_moments_of_a_quantised_signal(black, noise, spread, step):
    """Mean, temporal variance and covariance are those of drawn frames, where steps hide the noise and where it hides them."""
    generator = np.random.default_rng(1)
    signal = black + spread * generator.standard_normal(60_000) + noise * generator.standard_normal((6, 60_000))
    moments = dark_moments(np.maximum(np.floor(signal + step), 0).astype(np.uint8).reshape(6, 200, 300))
    z = (moments.values - expected_moments(black, noise, spread, step)) / np.sqrt(np.diag(moments.covariance))
    assert np.abs(z).max() < 4


def test_dark_noise_below_a_step():
    """Noise of 0.15 DN, half of it hidden: dark frames that change give its share over the step, and the line its size.

    Frames that stay at one value only bound it.
    """
    generator = np.random.default_rng(2)
    line = PhotonTransfer(0.01, 0.15**2 - 0.01 * 3.2, np.diag([1e-4, 3e-3]) ** 2, 60, 200)
    frames = 3.2 + 0.15 * generator.standard_normal((6, *SHAPE)) + 0.05 * generator.standard_normal(SHAPE)
    changing = fit_dark(dark_moments(np.floor(frames + 0.5).astype(np.uint8)), line, 0.5)
    assert changing.noise.low < 15 < changing.noise.high < 20
    assert changing.spread.low < 5 < changing.spread.high < 8
    assert 3.1 < changing.black.low < 3.2 < changing.black.high < 3.3
    still = fit_dark(dark_moments(np.full((6, *SHAPE), 3, np.uint8)), line, 0.5)
    assert still.noise.low == 0
    assert still.black.low < 3 - 0.4 < 3 + 0.4 < still.black.high


def test_figures_of_the_rig(shots):
    """All that images show of the rig's sensor, within 3.5 standard deviations, and to a few per cent."""
    found = identify_sensor(
        "cam1", shots.settings, dark=[shots.dark(), shots.dark(0.5)], flats=[shots.flat(0.3), shots.flat(0.7)]
    )
    least = {"saturation_e": 0.01, "dark_noise_e": 0.01, "dsnu_e": 0.03, "prnu": 0.03, "black_level_dn": 0.03}
    for name, relative in (least | {"dark_current_e_per_s": 0.05}).items():
        estimate, truth = found.estimates[f"cam1.sensor.{name}"], getattr(shots.sensor, name)
        assert abs(estimate.value - truth) < 3.5 * estimate.sigma, name
        assert estimate.sigma < relative * truth, name
    assert set(found.unknown) == {"cam1.sensor.adc_bits", "cam1.sensor.quantum_efficiency"}


@pytest.mark.parametrize(("bits", "adc_bits"), [(8, 8), (8, 10), (8, 12), (10, 12)])
def test_pixels_without_light_show_the_black_level_less_what_is_cut_off(rig, bits, adc_bits):
    """By 300 000 pixels of frames without light, to 0.01 DN of 8 bits; what is cut off is up to half a number."""
    sensor = rig.cam1.sensor.model_copy(update={"adc_bits": adc_bits, "dark_noise_e": 20.0, "dark_current_e_per_s": 0.0})
    shots = Shots(sensor, ImageSettings(bits, 1.0, adc_bits), 0.0, np.random.default_rng(9))
    shown = without_light(Estimate(sensor.black_level_dn, 0.1, "a test"), shots.settings)
    unit = 2.0 ** (bits - 8)
    assert shots.dark().frames.mean() == pytest.approx(shown.value, abs=0.01 * unit) and shown.sigma == 0.1 * unit


def test_flicker_is_no_noise(shots):
    """A lamp that flickers by 5 % changes the gain by less than three of its standard deviations; naive variance by far more."""
    strong = Shots(shots.sensor, shots.settings, 0.05, shots.generator)
    flats = [strong.flat(0.3), strong.flat(0.6)]
    estimate = identify_sensor("cam1", shots.settings, dark=[shots.dark()], flats=flats).estimates["cam1.sensor.saturation_e"]
    assert abs(estimate.value - shots.sensor.saturation_e) < 3.5 * estimate.sigma
    naive = flats[1].var(axis=0, ddof=1).mean()
    assert naive > 2 * noise_dn(np.float32(0.6 * shots.sensor.saturation_e), shots.sensor, Exposure(EXPOSURE_S)) ** 2


@pytest.mark.parametrize("name", SEQUENCES)
def test_patterns_alone_know_the_gain_only(shots, name):
    """Without dark frames, black level and dark noise are known together, and the scene's texture hides the pixels' response.

    Of binary fringes the odd harmonics are light, of codes a frame and its inverse together.
    """
    found = identify_sensor("cam1", shots.settings, sequences=[shots.sequence(name)])
    estimate = found.estimates["cam1.sensor.saturation_e"]
    assert abs(estimate.value - shots.sensor.saturation_e) < 3.5 * estimate.sigma
    assert estimate.sigma < 0.05 * estimate.value
    assert set(found.estimates) == {"cam1.sensor.saturation_e", "noise_at_zero_dn2.cam1"}
    assert "dark_noise_e^2 - K black" in found.unknown["cam1.sensor.black_level_dn"]
    assert "texture" in found.unknown["cam1.sensor.prnu"]


def variance_over(level, sensor, settings):
    """Temporal variance of one frame of 8 bits, DN^2, at mean levels of the image, DN, by EMVA 1288's line and rounding."""
    gain = (1.0 if settings.gain is None else settings.gain) * (256 - sensor.black_level_dn) / sensor.saturation_e
    signal = level + 0.5 - settings.step[0] - sensor.black_level_dn
    return gain * signal + (gain * sensor.dark_noise_e) ** 2 + 1 / 12


@pytest.mark.parametrize("black_dn", [0.0, 2.0, 9.0])
def test_a_sensor_known_by_its_line_has_that_noise(shots, black_dn):
    """Black level and dark noise are assumed wrongly; the variance over level is the true one within 3 %."""
    found = identify_sensor("cam1", shots.settings, sequences=[shots.sequence("inverses")])
    value = found.estimates["cam1.sensor.saturation_e"].value
    assumed = shots.sensor.model_copy(update={"saturation_e": value, "dark_noise_e": 40.0, "black_level_dn": black_dn})
    sensors = (shots.sensor, with_noise_as_seen(assumed, "cam1", shots.settings, found), assumed)
    expected, seen, wrong = (variance_over(np.linspace(20, 220, 6), one, shots.settings) for one in sensors)
    np.testing.assert_allclose(seen, expected, rtol=0.03)
    assert np.abs(wrong / expected - 1).max() > 0.05


@pytest.mark.parametrize("name", SEQUENCES)
def test_errors_of_frames_are_no_noise(shots, name):
    """The variance by level is the twin's with frames of a light that differs by 5 %, within 3 % in the mean over tiles."""
    strong = Shots(shots.sensor, shots.settings, 0.05, shots.generator)
    stack = strong.sequence(name)
    noise = noise_of_patterns(stack.images, stack.patterns, 8)
    assert noise is not None
    expected = variance_over(noise.level, shots.sensor, shots.settings)
    assert np.average(noise.variance / expected, weights=noise.freedom) == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize(("unwrap", "pitches", "codes"), [("gray", (16,), [CODE]), ("heterodyne", (16, 64, 256), [])])
def test_a_few_steps_show_no_noise(unwrap, pitches, codes):
    """Of sets of three steps, and of a code without its inverse, nothing is left that isn't light."""
    parts = [*({"kind": "fringes", "pitch": pitch, "steps": 3} for pitch in pitches), *codes]
    patterns = Patterns.model_validate({"projector_size": (256, 192), "unwrap": unwrap, "parts": parts})
    assert noise_of_patterns(np.full((sum(part.count for part in patterns.parts), *SHAPE), 100, np.uint8), patterns, 8) is None


def test_a_board_with_a_pattern_bounds_the_response(shots):
    """A print of 3 % that is blurred over pixels is no PRNU."""
    flats = [shots.flat(share, texture=0.03) for share in (0.3, 0.6)]
    found = identify_sensor("cam1", shots.settings, dark=[shots.dark()], flats=flats)
    assert "at most" in found.unknown["cam1.sensor.prnu"]


def test_dark_frames_alone(shots):
    """They know the black level; electrons need a gain."""
    found = identify_sensor("cam1", shots.settings, dark=[shots.dark()])
    estimate = found.estimates["cam1.sensor.black_level_dn"]
    assert abs(estimate.value - shots.sensor.black_level_dn) < 2 * estimate.sigma  # nearly all by dark current, which isn't seen
    assert "DN; electrons need a gain" in found.unknown["cam1.sensor.dark_noise_e"]


def scores(seeds: range) -> dict[str, list[float]]:
    """Errors by their standard deviations, of random sensors, by parameter."""
    found: dict[str, list[float]] = {}
    for seed in seeds:
        shots = drawn(seed)
        dark = [shots.dark(), shots.dark(0.5)]
        estimates = identify_sensor("cam1", shots.settings, dark=dark, flats=[shots.flat(0.25), shots.flat(0.6)]).estimates
        for name, estimate in estimates.items():
            field = name.rsplit(".", 1)[1]
            found.setdefault(field, []).append((estimate.value - getattr(shots.sensor, field)) / estimate.sigma)
    return found


@pytest.mark.slow
def test_coverage():
    """95 % intervals hold the truth of random sensors as often as they say, within the 99.9 % of a binomial number."""
    found = scores(range(24))
    assert set(found) == {"saturation_e", "dark_noise_e", "black_level_dn", "dsnu_e", "prnu", "dark_current_e_per_s"}
    for name, z in found.items():
        assert len(z) >= 14, name
        inside = np.count_nonzero(np.abs(z) < 1.96)
        assert inside >= stats.binom.ppf(0.0005, len(z), 0.95), (name, sorted(z))
        assert np.std(z) > 0.5, name  # no interval is twice too wide


def test_noise_of_a_real_recording(real):
    """The line of half the tiles predicts the variance of the other half, by level: 5 % above 15 DN, and 10 % below.

    Frames of this projector differ by gain, offset and shift, and by harmonics that follow the fringes: several times the noise.
    """
    images = [cv2.imread(str(real / "fringe_capture" / f"{k:02d}.png"), cv2.IMREAD_GRAYSCALE) for k in range(12)]
    noise = noise_of_fringes(np.stack(images), 2 * np.pi * np.arange(12) / 12, 8)
    one, other = (TileNoise(*(values[half::2] for values in noise)) for half in (0, 1))
    line = transfer_line(one)
    assert line is not None
    for low, high, bar in ((6, 10, 0.1), (10, 15, 0.1), (60, 80, 0.05), (80, 100, 0.05), (100, 120, 0.05), (120, 140, 0.05)):
        part = (other.level >= low) & (other.level < high)
        ratio = other.variance[part].mean() / line.variance(other.level[part]).mean()
        assert ratio == pytest.approx(1, abs=bar), (low, high)
