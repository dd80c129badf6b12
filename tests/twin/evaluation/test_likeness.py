"""Statistics of a capture beside its rendering, against closed forms and noise that was drawn."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import j1, ndtr

from recon.model.patterns import Fringes, GrayCode, Patterns
from recon.structured_light.decode import decode
from recon.structured_light.triangulate import PointMap
from twin.conditions import Frames
from twin.evaluation import likeness
from twin.evaluation.likeness import Profile, Statistic, Taken, passed_by, width_of
from twin.optics.seen_surface import seen_light
from twin.reports import likeness_report

SHAPE = (224, 320)
STEPS = 8
SEQUENCE = Patterns(
    projector_size=(1024, 64),
    unwrap="gray",
    parts=(Fringes(pitch=16, steps=STEPS), GrayCode(pitch=16, bits=6, complementary=True)),
)
X = np.linspace(-300, 300, 1201)  # projector px across an edge


def light_of(gamma: float = 1.0, gains=None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Images without noise of a plane that sees two projector px a camera px, its reflectance, and the dark level, DN."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    x = 60.3 + 2.37 * u + 0.01 * v
    albedo, dark = 90 + 70 * np.sin(0.02 * v) * np.cos(0.013 * u), 12.0
    images = []
    for part, place in SEQUENCE.slices():
        for k in range(place.stop - place.start):
            if isinstance(part, Fringes):
                phase = 2 * np.pi * (x - part.zero(1024)) / part.pitch + part.shifts[k]
                level = ((1 + np.cos(phase)) / 2) ** gamma
            else:
                level = part.profiles(1024)[k][np.rint(x).astype(int)]
            images.append((1 if gains is None else gains[place.start + k]) * albedo * level + dark)
    return np.array(images), albedo, np.full(SHAPE, dark)


def taken(images: np.ndarray, gamma: float = 1.0) -> Taken:
    """A capture of whole numbers; its distances are those of a smooth surface."""
    numbers = np.clip(np.rint(images), 0, 255).astype(np.uint8)
    found = decode(numbers, SEQUENCE)
    sigma = np.full(SHAPE, 0.05, np.float32)
    points = PointMap(np.zeros((*SHAPE, 3), np.float32), sigma)
    distance = np.float32(650 + np.random.default_rng(3).normal(0, 0.05, SHAPE))
    return Taken(numbers, SEQUENCE, 8, found, points, distance, seen_light(numbers, SEQUENCE, found, gamma, 255.0))


def noisy(images: np.ndarray, rng: np.random.Generator, gain: float = 0.04) -> np.ndarray:
    return images + np.sqrt(1.0 + gain * images) * rng.standard_normal(images.shape)


def compared(real: Taken, twin: Taken, frames: Frames | None = None) -> likeness.Likeness:
    return likeness.compare(real, twin, np.ones(SHAPE, bool), frames or Frames())


def test_what_is_alike_is_explained(rng):
    """Two draws of one model: nothing is beyond its bar, and the words say so."""
    images, _, _ = light_of()
    real, twin = (taken(noisy(images, rng)) for _ in range(2))
    found = compared(real, twin)
    assert not found.off, found.off
    assert next(likeness_report.unexplained(real, found)).startswith("Nothing: all 9 statistics")
    assert found["modulation_correlation"].value > 0.99 and found["harmonics"].value < 0.002


@pytest.mark.parametrize("third", [0.0, 0.06])
def test_halves_of_the_steps_tell_how_alike_two_captures_are(rng, third):
    """Maps of modulation of two draws have the correlation that each draw's own halves predict, within 0.01.

    With errors of frames of 2 %, and noise: they leave 0.8 to 0.95 of it. Third harmonics, which four steps take for the first,
    fall out.
    """
    fringes = SEQUENCE.parts[0]
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    phase = 2 * np.pi * (60.3 + 2.37 * u + 0.01 * v - fringes.zero(1024)) / fringes.pitch + fringes.shifts[:, None, None]
    draws = []
    for _ in range(2):
        images, albedo, _ = light_of(gains=1 + 0.02 * rng.standard_normal(SEQUENCE.count))
        images[:STEPS] += third * albedo / 2 * np.cos(3 * phase)
        draws.append(taken(noisy(images, rng, 0.6)))
    found = compared(*draws)
    assert 0.8 < found["modulation_correlation"].value < 0.95
    assert found["modulation_repeated"].value == pytest.approx(found["modulation_correlation"].value, abs=0.01)


def test_harmonics_of_other_fringes_stay_out_of_halves_of_the_steps(rng):
    """Six steps before them, of another pitch and with a third harmonic of the other sign, change nothing."""
    fringes, before = SEQUENCE.parts[0], Fringes(pitch=64, steps=6)
    x = 60.3 + 2.37 * np.arange(SHAPE[1])[None] + 0.01 * np.arange(SHAPE[0])[:, None]
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    albedo, images = 40 + 30 * np.sin(0.02 * v) * np.cos(0.013 * u), []
    for part, third in ((before, -0.2), (fringes, 0.2)):
        phase = 2 * np.pi * x / part.pitch + part.shifts[:, None, None]
        images.append(noisy(90 + albedo * (np.cos(phase) + third * np.cos(3 * phase)), rng, 0.3))
    side = taken(noisy(light_of()[0], rng))
    both = np.ones(SHAPE, bool)
    alone = replace(side, images=images[1], patterns=SEQUENCE.model_copy(update={"parts": (fringes,)}))
    after = replace(side, images=np.concatenate(images), patterns=SEQUENCE.model_copy(update={"parts": (before, fringes)}))
    assert 0.8 < likeness.repeated(alone, both) < 0.99
    assert likeness.repeated(after, both) == pytest.approx(likeness.repeated(alone, both), rel=1e-9)


@pytest.mark.parametrize("gain", [0.03, 0.052])
def test_noise_of_another_gain_is_found_and_named(rng, gain):
    """Variances are 1 + gain * level, with 1/12 of rounding: their ratio is that in each level, and the gain's is the cause."""
    images, _, _ = light_of()
    real, twin = taken(noisy(images, rng, gain)), taken(noisy(images, rng, 0.04))
    found = compared(real, twin)
    level = found.noise.level
    expected = (1 + 1 / 12 + gain * level) / (1 + 1 / 12 + 0.04 * level)
    assert np.abs((found.noise.real / found.noise.twin - expected) / found.noise.sigma).max() < 4
    first, *others = likeness_report.unexplained(real, found)
    assert "saturation_e" in first and all("by the noise above" in line for line in others)


def test_a_gamma_shows_in_the_second_harmonic(rng):
    """(gamma - 1) / (gamma + 2) of the modulation, the third (gamma - 1)(gamma - 2) / ((gamma + 2)(gamma + 3))."""
    gamma = 2.2
    real, twin = taken(noisy(light_of(gamma)[0], rng), gamma), taken(noisy(light_of()[0], rng))
    found = compared(real, twin)
    ours, theirs = found.harmonics
    assert ours[0] == pytest.approx((gamma - 1) / (gamma + 2), abs=2e-3)
    assert ours[1] == pytest.approx((gamma - 1) * (gamma - 2) / ((gamma + 2) * (gamma + 3)), abs=2e-3)
    assert np.abs(theirs).max() < 2e-3
    assert found.off[0].name == "harmonics" and "gamma" in next(likeness_report.unexplained(real, found))


def test_flicker_is_found_as_it_was_drawn(rng):
    """Gains of the eight frames of fringes, within a tenth, as offsets may stand for them; of conditions that have none."""
    gains = 1 + 0.05 * np.array([1, -1, -1, 1, 1, 1, -1, -1, *[0] * 7])
    real, twin = taken(noisy(light_of(gains=gains)[0], rng)), taken(noisy(light_of()[0], rng))
    found = compared(real, twin)
    light = np.hypot(found.frames.real.flicker * found.frames.level_dn, found.frames.real.stray_dn)
    assert light == pytest.approx(0.05 * found.frames.level_dn * np.sqrt(8 / 7), rel=0.1)
    assert not found["temporal_spectrum"].explained
    assert any(line.startswith("Flicker: ") for line in likeness_report.unexplained(real, found))
    same = compared(real, twin, Frames(flicker=0.05))
    drawn, noise = (0.05 * same.frames.level_dn) ** 2, same.noise.twin.mean()
    assert same["temporal_spectrum"].explained
    assert same["temporal_spectrum"].sigma == pytest.approx(np.sqrt(2 / 7) * drawn / (drawn + noise), rel=1e-6)


def test_grain_that_is_not_white_is_found(rng):
    """Noise behind a Gaussian of 0.6 px, of the same variance, has less than half of its share at the finest periods."""
    images, _, _ = light_of()
    grain = gaussian_filter(rng.standard_normal(images.shape), (0, 0.6, 0.6))
    level = np.sqrt(1.0 + 0.04 * images)
    real, twin = taken(images + level * grain / grain.std()), taken(noisy(images, rng))
    found = compared(real, twin)
    expected = np.exp(-4 * np.pi**2 * 0.36 * found.spatial.frequency**2)
    assert found.spatial.real[-1] / found.spatial.real[0] == pytest.approx(expected[-1] / expected[0], abs=0.2)
    assert "spatial_spectrum" in [one.name for one in found.off] and found["noise_variance"].explained


def test_reflectance_and_dark_are_those_under_stripes(rng):
    """Whatever gamma the fringes pass; within the noise of three wide stripes."""
    images, albedo, dark = light_of(gamma=2.2)
    side = taken(noisy(images, rng))
    known = np.isfinite(side.light.bright) & np.isfinite(side.light.dark)
    off = (side.light.bright - side.light.dark - albedo)[known]
    assert known.mean() > 0.9 and abs(np.median(off)) < 0.1 and off.std() < 3.5
    assert abs(np.median((side.light.dark - dark)[known])) < 0.1


def test_widths_and_modulation_by_edges_are_closed_forms():
    """Behind a Gaussian exp(-2 pi^2 sigma^2 / pitch^2), behind a disc 2 J1(z) / z of the fringes' modulation are left."""
    sigma, radius, pitch = 5.0, 12.0, 48.0
    y = np.clip(X / radius, -1, 1)
    disc = 0.5 + (y * np.sqrt(1 - y * y) + np.arcsin(y)) / np.pi
    gaussian = ndtr(X / sigma)
    assert width_of(X, gaussian) == pytest.approx(1.349 * sigma, rel=1e-3)
    assert width_of(X, disc) == pytest.approx(0.808 * radius, rel=2e-3)
    z = 2 * np.pi * radius / pitch
    assert passed_by(X, gaussian, pitch) == pytest.approx(np.exp(-2 * (np.pi * sigma / pitch) ** 2), abs=2e-3)
    assert passed_by(X, disc, pitch) == pytest.approx(2 * j1(z) / z, abs=2e-3)
    for light, smaller in ((disc, 0), (gaussian, 1)):
        off = likeness_report.shapes_of_edge(Profile(X, light, light))
        assert off[smaller] < 2e-3 < 5e-3 < off[1 - smaller]


def test_light_beyond_edges_is_a_halo():
    """Two per cent of the light spread evenly: half of it lies on either side."""
    sharp = ndtr(X / 1.5)
    real = 0.98 * sharp + 0.01
    ours, theirs = likeness.halo_of(Profile(X, real, sharp), 2.0)
    assert ours == pytest.approx(0.01, abs=1e-4) and abs(theirs) < 1e-4


def test_a_bar_is_widened_by_chance():
    """Three standard deviations; what nothing shows, and what has no bar, is never off."""
    one = Statistic("edge_width", 1.16, 1, 0.1)
    assert one.off == pytest.approx(1.6) and not one.explained
    assert replace(one, sigma=0.03).explained and replace(one, value=0.7, sigma=0.03).off == pytest.approx(2.1)
    assert replace(one, value=np.nan).explained and replace(one, bar=np.nan).explained
