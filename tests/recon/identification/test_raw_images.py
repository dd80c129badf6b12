"""Images that cameras have processed are told by their noise, and raw ones aren't taken for such."""

import re

import cv2
import numpy as np
import pytest

from recon.identification.photon_transfer import TileNoise, noise_of_flat, noise_of_patterns, transfer_line
from recon.identification.raw_images import describe_drift, describe_processing
from recon.identification.sensors import DarkStack, ImageSettings, identify_sensor
from tests.recon.identification.test_sensors import SEQUENCES, Shots, drawn, shots

__all__ = ["shots"]  # a fixture

SHAPE = 256, 320
GAIN, BLACK = 0.03, 4.0  # DN an electron, DN


def light(level: float, count: int = 8, seed: int = 1) -> np.ndarray:
    """Frames before the converter, DN of 8 bits : (count, h, w), of a light that falls to a third across the image."""
    rng = np.random.default_rng([seed, int(level)])
    electrons = np.broadcast_to(np.linspace(level, level / 3, SHAPE[1]) / GAIN, SHAPE)
    return GAIN * rng.poisson(electrons, (count, *SHAPE)) + BLACK


def stored(frames: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(frames), 0, 255).astype(np.uint8)


def each(change):
    """Whole frames stored, then changed one by one."""
    return lambda frames: np.stack([change(one) for one in stored(frames)])


def jpeg(quality: int):
    return each(lambda one: cv2.imdecode(cv2.imencode(".jpg", one, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_GRAYSCALE))


def with_gamma(power: float):
    return lambda frames: stored(255 * (np.clip(frames, 0, 255) / 255) ** power)


def demosaiced(one: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(cv2.cvtColor(one, cv2.COLOR_BayerBG2BGR), cv2.COLOR_BGR2GRAY)


def sharpened(one: np.ndarray) -> np.ndarray:
    return stored(1.5 * one.astype(float) - 0.5 * cv2.GaussianBlur(one.astype(float), (0, 0), 1.0))


def enlarged(one: np.ndarray) -> np.ndarray:
    return cv2.resize(one[: 2 * SHAPE[0] // 3, : 2 * SHAPE[1] // 3], SHAPE[::-1], interpolation=cv2.INTER_LINEAR)


PROCESSING = {
    "JPEG of quality 85": (jpeg(85), "alike .* as by JPEG"),
    "JPEG of quality 95": (jpeg(95), "JPEG"),
    "demosaiced": (each(demosaiced), "alike .* demosaiced"),
    "denoised": (each(lambda one: cv2.medianBlur(one, 3)), "alike .* denoising"),
    "enlarged": (each(enlarged), "alike .* upscaling"),
    "sharpened": (each(sharpened), "opposed .* sharpening"),
    "a gamma of 0.45": (with_gamma(0.45), "noise doesn't rise with the level, as by a gamma"),
    "a gamma of 0.8": (with_gamma(0.8), r"isn't a straight line \(its middle is \+.* gamma"),
}


def described(stacks: list[np.ndarray]) -> str | None:
    noise = TileNoise(*map(np.concatenate, zip(*(noise_of_flat(frames, 8) for frames in stacks), strict=True)))
    return describe_processing(noise, transfer_line(noise), by_flats=True)


@pytest.mark.parametrize("name", PROCESSING)
def test_processing_is_named(name):
    """By flat frames of two levels, which are raw without it."""
    change, words = PROCESSING[name]
    frames = [light(100), light(210)]
    assert described([stored(one) for one in frames]) is None
    found = described([change(one) for one in frames])
    assert re.search(words, found or ""), found


@pytest.mark.parametrize("share", [0.0, 0.1, -0.1])
def test_correlation_of_neighbours_is_the_filters(share):
    """Of noise under a filter (a, 1 - 2 a, a) along rows: its autocorrelation, within four standard deviations."""
    rng, kernel = np.random.default_rng(5), np.array([[share, 1 - 2 * share, share]])
    frames = np.stack([cv2.filter2D(one, -1, kernel) for one in 20 * rng.standard_normal((6, *SHAPE)) + 2000])
    noise = noise_of_flat(np.rint(frames).astype(np.uint16), 12)
    expected = [2 * share * (1 - 2 * share) / ((1 - 2 * share) ** 2 + 2 * share**2), 0, 0]
    mean, sigma = noise.beside.mean(axis=0), noise.beside.std(axis=0) / np.sqrt(len(noise.beside))
    assert np.abs((mean[:3] - expected) / sigma[:3]).max() < 4 and sigma[:3].max() < 0.01
    assert abs(mean[4] / sigma[4]) < 4


@pytest.mark.parametrize("seed", range(3))
def test_raw_images_are_not_taken_for_processed(seed):
    """Of random sensors, under a lamp that flickers, on a striped scene, by flat frames and all kinds of patterns."""
    shots = drawn(seed)
    for name in SEQUENCES:
        stack = shots.sequence(name)
        noise = noise_of_patterns(stack.images, stack.patterns, shots.settings.bits)
        assert noise is not None and describe_processing(noise, transfer_line(noise), by_flats=False) is None, name


def test_of_processed_images_no_number_is_given_unless_asked_for(shots: Shots):
    """Median filters leave a third of the variance: the gain would be wrong by as much, with a small sigma."""
    flats = [np.stack([cv2.medianBlur(one, 3) for one in shots.flat(share)]) for share in (0.3, 0.7)]
    dark: list[DarkStack] = [shots.dark()]
    found = identify_sensor("cam1", shots.settings, dark=dark, flats=flats)
    assert not found.estimates and all(why.startswith("images aren't raw: noise of nei") for why in found.unknown.values())
    asked = ImageSettings(8, 1.0, 10, processed=True)
    taken = identify_sensor("cam1", asked, dark=dark, flats=flats).estimates["cam1.sensor.saturation_e"]
    assert taken.value > 1.5 * shots.sensor.saturation_e and "taken for raw ones" in taken.source


def test_a_light_that_drifts_is_no_lamp_that_flickers():
    """Frames that rise one after another by a fifth; not those whose light scatters by 5 %."""
    rng = np.random.default_rng(3)
    scattered = 100 * (1 + 0.05 * rng.standard_normal(16))
    rising = 100 * np.linspace(1, 1.2, 16)
    flat, drifting = (np.broadcast_to(one[:, None, None], (16, 16, 16)) for one in (scattered, rising))
    assert describe_drift([flat]) is None
    assert "drift by 20 %, as by auto exposure" in (describe_drift([flat, drifting]) or "")
