"""Errors of frames: are they found, is the phase as good as without them, and is what is left in sigma?"""

import cv2
import numpy as np
import pytest

from recon.model.patterns import Fringes
from recon.structured_light import frame_errors
from recon.structured_light.phase import FrameErrors, Noise, design, estimate_noise, pseudo_inverse, steady, wrapped_phase

NOISE = Noise(0.5, 0.033)
SHAPE = (400, 520)
PITCH = 12.0
STEADY = (0.0, 0.0, 0.0)
LAMP = (0.05, 1.5, 0.02)  # standard deviations of gains, of offsets in DN, and of shifts in steps


def plane(rng):
    """Projector columns and reflectance of a slanted white plane."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    return 0.55 * u + rng.uniform(-0.1, 0.1) * v, np.ones(SHAPE)


def skin(rng):
    """The same of a curved surface whose reflectance varies on every scale, under a lamp brighter in the middle."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    texture = sum(s * cv2.GaussianBlur(rng.normal(size=SHAPE), (0, 0), s) for s in (2, 5, 12, 30))
    reflectance = np.clip(1 + 0.25 * texture / texture.std(), 0.2, 2) * np.exp(-(((u - 260) / 400) ** 2) - ((v - 200) / 400) ** 2)
    return 0.55 * u + 6 * np.sin(u / 200 + v / 300), reflectance


def ball(rng):
    """The same of something small in the dark."""
    columns, _ = plane(rng)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return columns, (np.hypot(u - 260, v - 200) < 120).astype(float)


def steps(rng):
    """The same of white planes on which fringes are of usual width, twice as wide, and hardly there."""
    columns, reflectance = plane(rng)
    u = np.arange(SHAPE[1])
    return np.where(u < 380, columns, np.where(u < 450, 0.5 * columns, 0.02 * columns)), reflectance


def photograph(scene, n, rng, sigmas=STEADY, gamma=0.0):
    """Images : (n, h, w) uint8, shifts, true phase, and the errors drawn : (3, n); `gamma` is a second harmonic."""
    columns, reflectance = scene
    shifts, phase = 2 * np.pi * np.arange(1, n + 1) / n, 2 * np.pi * columns / PITCH
    gain, offset, shift = errors = rng.normal(size=(3, n)) * np.array([*sigmas[:2], sigmas[2] * 2 * np.pi / n])[:, None]
    images = []
    for k in range(n):
        angle = phase + shifts[k] + shift[k]
        light = 8 + reflectance * 160 * (0.5 + 0.45 * np.cos(angle) + gamma * np.cos(2 * angle))
        mean = (1 + gain[k]) * light + offset[k]
        noise = rng.normal(size=SHAPE) * np.sqrt(np.maximum(NOISE.read_variance - 1 / 12 + NOISE.gain * mean, 0))
        images.append(np.clip(np.rint(mean + noise), 0, 255).astype(np.uint8))
    return np.stack(images), shifts, phase, errors


def estimate(images, shifts):
    return frame_errors.estimate(images, shifts, least_modulation=4, saturation=255)


def phase_errors(images, shifts, phase, errors=None):
    """Errors of the decoded phase without their mean, which is the mean shift, and these over sigma, of lit pixels."""
    found = wrapped_phase(images, shifts, noise=NOISE, saturation=255, errors=errors)
    lit = (found.modulation > 15) & ~found.saturated
    off = np.angle(np.exp(1j * (found.phase - phase)))[lit]
    off -= off.mean()
    return off, off / found.sigma[lit]


def test_computed_images_show_no_errors():
    """Fringes of whole projector px, seen pixel by pixel without noise: all periods are alike, their rounding errors, too."""
    fringes = Fringes(pitch=PITCH, steps=8, first=1)
    columns = np.arange(SHAPE[1]) - fringes.zero(SHAPE[1])
    images = (16 * np.rint(255 * fringes.profiles(SHAPE[1]))).astype(np.uint16)
    images = np.broadcast_to(images[:, None], (8, *SHAPE))
    found = frame_errors.estimate(images, fringes.shifts, least_modulation=64, saturation=4095)
    assert np.abs(found.gain).max() < 0.02 and np.abs(found.shift).max() < 0.01
    phase = wrapped_phase(images, fringes.shifts, noise=Noise(14.0, 0.0), saturation=4095, errors=found).phase
    off = np.angle(np.exp(1j * (phase - 2 * np.pi * columns / PITCH)))
    assert np.abs(off).max() < 4 / np.pi * 0.5 / 127.5  # the largest by rounding to half a DN


LAMPS = [
    pytest.param(n, scene, most, gamma, id=f"{gamma}-{scene.__name__}-{most}-{n}")
    for n, gamma in ((4, 0.03), (5, 0.0), (8, 0.03), (18, 0.0))
    for scene, most in ((plane, 1.05), (skin, 1.1), (ball, 1.2), (steps, 1.05))
]


@pytest.mark.parametrize(("n", "scene", "most", "gamma"), LAMPS)
def test_phase_is_as_good_as_of_a_steady_lamp(rng, n, scene, most, gamma):
    """RMS nearly that of the undisturbed phase; what texture and size leave of the errors is in sigma."""
    seen = scene(rng)
    ideal = phase_errors(*photograph(seen, n, rng, STEADY, gamma)[:3])[0].std()
    images, shifts, phase, _ = photograph(seen, n, rng, LAMP, gamma)
    _, raw_z = phase_errors(images, shifts, phase)
    off, z = phase_errors(images, shifts, phase, estimate(images, shifts))
    assert raw_z.std() > 1.05  # so that there is something to find
    assert off.std() < most * ideal
    assert 0.95 < z.std() < 1.05


@pytest.mark.parametrize("n", [4, 8])
@pytest.mark.parametrize("scene", [plane, skin, ball, steps])
def test_a_steady_sequence_stays_as_it_is(rng, n, scene):
    """Nothing is found, nothing is lost: the phase's noise and sigma grow by less than 1 %."""
    images, shifts, phase, _ = photograph(scene(rng), n, rng)
    before, z_before = phase_errors(images, shifts, phase)
    after, z_after = phase_errors(images, shifts, phase, estimate(images, shifts))
    assert after.std() < 1.01 * before.std()
    assert abs(z_after.std() / z_before.std() - 1) < 0.01


@pytest.mark.parametrize("n", [8, 12])
def test_errors_are_found_to_their_uncertainty(rng, n):
    """Of 5 draws, each over its standard deviation; what the mean gain, offset and shift would be isn't known."""
    z = []
    for _ in range(5):
        images, shifts, _, truth = photograph(skin(rng), n, rng, LAMP)
        found = estimate(images, shifts)
        off = np.stack(found[:3]) - (truth - truth.mean(axis=1, keepdims=True))
        sigma = np.sqrt(np.diag(found.covariance).reshape(3, n))
        z.append(off[0] / np.hypot(sigma[0], LAMP[0] ** 2))  # gains are relative to their mean
    assert 0.5 < np.std(z) < 2


def test_the_covariance_is_in_sigma(rng):
    """Phase errors of drawn frame errors have the variance that `phase_variance` gives, by the definition of both."""
    n, a, b = 8, 90.0, 60.0
    shifts = 2 * np.pi * np.arange(n) / n
    root = rng.normal(size=(3 * n, 3 * n)) * np.repeat([3e-4, 0.02, 3e-4], n)[:, None]
    by_offset, by_both, by_gain, rest = FrameErrors(*np.zeros((3, n)), root @ root.T).phase_variance(shifts)
    gain, offset, shift = (rng.normal(size=(40_000, 3 * n)) @ root.T).reshape(-1, 3, n).transpose(1, 0, 2)
    phase = rng.uniform(-np.pi, np.pi, (len(gain), 1))
    images = (1 + gain) * (a + b * np.cos(phase + shifts + shift)) + offset
    _, c, s = pseudo_inverse(shifts) @ images.T
    off = np.angle((c + 1j * s) * np.exp(-1j * phase[:, 0]))
    assert np.var(off) == pytest.approx((by_offset + by_both * a + by_gain * a * a) / b**2 + rest, rel=0.04)


def test_known_errors_are_taken_off(rng):
    """Noiseless images with errors give the exact phase once the errors are known, whatever they are."""
    n = 5
    shifts, phase = 2 * np.pi * np.arange(n) / n, rng.uniform(-np.pi, np.pi, (6, 50))
    gain, offset, shift = rng.normal(size=(3, n)) * [[0.1], [5], [0.1]]
    errors = FrameErrors(gain, offset, shift, np.zeros((3 * n, 3 * n)))
    waves = np.tensordot(design(shifts + shift), np.stack([np.full_like(phase, 100), 80 * np.cos(phase), 80 * np.sin(phase)]), 1)
    images = (1 + gain)[:, None, None] * waves + offset[:, None, None]
    found = wrapped_phase(images.astype(np.float32), shifts, noise=NOISE, saturation=255, errors=errors)
    assert np.abs(np.angle(np.exp(1j * (found.phase - phase)))).max() < 1e-4
    assert found.modulation == pytest.approx(80, abs=0.01)


def test_errors_are_no_noise(rng):
    """The camera's noise is the same with a flickering lamp as with a steady one."""
    images, shifts, *_ = photograph(skin(rng), 8, rng, (0.1, 2.0, 0.05))
    wrong = estimate_noise(images, shifts)
    found = estimate_noise(images, shifts, errors=estimate(images, shifts))
    level = 90.0
    true = NOISE.read_variance + NOISE.gain * level
    assert wrong.read_variance + wrong.gain * level > 1.3 * true
    assert found.read_variance + found.gain * level == pytest.approx(true, rel=0.05)


def test_what_cannot_be_seen_is_left(rng):
    """Three frames fit any errors; a dark image shows none."""
    images, shifts, *_ = photograph(plane(rng), 3, rng, LAMP)
    for found, n in ((estimate(images, shifts), 3), (estimate(np.full((8, 60, 80), 3, np.uint8), np.arange(8.0)), 8)):
        assert all(np.array_equal(one, other) for one, other in zip(found, steady(n), strict=True))
