"""Three and four steps under a gamma that nobody knows: measured on the fringes, undone, counted in sigma, and said."""

import numpy as np
import pytest

from recon.errors import InputError
from recon.model.patterns import CentreLine, Fringes, GrayCode, Patterns
from recon.structured_light.decode import Status, decode
from recon.structured_light.surface_figures import describe_decoding
from tests.recon.fringe_scenes import NOISE, photograph

CODE = GrayCode(pitch=18, bits=7, complementary=True)
PARTS = {
    "backwards": (Fringes(pitch=18, steps=3, first=2, backwards=True), CODE),
    "four": (Fringes(pitch=18, steps=4), CODE),
    "line": (CentreLine(), Fringes(pitch=18, steps=3)),
    "three pitches": (Fringes(pitch=18, steps=3), Fringes(pitch=140, steps=3), Fringes(pitch=1332, steps=3)),
}
UNWRAP = {"backwards": "gray", "four": "gray", "line": "centre_line", "three pitches": "heterodyne"}


def errors(name, gamma, rng):
    """Errors and sigma of the decoded columns of a bowed wall, and the map."""
    patterns = Patterns(projector_size=(1280, 800), unwrap=UNWRAP[name], parts=PARTS[name])
    v, u = np.mgrid[:160, :480].astype(float)
    x = 639.5 + 1.4 * (u - 240) + 0.05 * v + 1e-4 * (u - 240) ** 2
    found = decode(photograph(patterns, {"columns": x}, rng, light=150, blur=0.8, gamma=gamma), patterns)
    ok = found.status == Status.OK
    assert ok.mean() > 0.9
    return (found.columns - x)[ok], found.sigma_columns[ok], list(describe_decoding(patterns, found))


@pytest.mark.parametrize("name", PARTS)
def test_an_unknown_gamma_costs_little_and_is_counted(rng, name):
    """At most 1.3 times the noise of linear light; errors divided by sigma stay standard normal; the console says it."""
    linear, _, lines = errors(name, 1.0, rng)
    assert not any(line.startswith("linearity") for line in lines)
    for gamma in (0.7, 2.6):
        error, sigma, lines = errors(name, gamma, rng)
        assert any(line.startswith("linearity   light isn't linear") for line in lines)
        if gamma > 1:  # below 1 fringes have less modulation, and so more noise
            assert np.sqrt(np.mean(error**2)) < 1.3 * np.sqrt(np.mean(linear**2))
        z = error / sigma
        assert abs(z.std() - 1) < 0.04  # some 70 000 values, 0.3 %; what is left of the bend is a tenth of the noise
        assert abs(z).max() < 7


@pytest.mark.parametrize(
    ("pitch", "across", "cause"), [(320, 1.4, "too few periods"), (18, 4.7, "periods of so few camera pixels")]
)
def test_fringes_that_hide_a_gamma_are_said(rng, pitch, across, cause):
    """Two periods on a wall, or periods of 3.8 camera pixels: three steps are bent, and nothing shows by how much."""
    parts = (Fringes(pitch=pitch, steps=3), GrayCode(pitch=pitch, bits=2 if pitch == 320 else 7))
    columns = 639.5 + across * (np.mgrid[:160, :240][1] - 120.0)
    found = decode(photograph(patterns_of(parts), {"columns": columns}, rng, light=150), patterns_of(parts))
    (said,) = (line for line in describe_decoding(patterns_of(parts), found) if line.startswith("linearity"))
    assert cause in said


def patterns_of(parts):
    return Patterns(projector_size=(1280, 800), unwrap="gray", parts=parts)


def seen(steps, rng, gamma=1.0, ambient=8.0):
    """Patterns of 36 px, and their images of a wall."""
    patterns = patterns_of((Fringes(pitch=36, steps=steps), GrayCode(pitch=36, bits=6)))
    columns = 639.5 + 1.4 * (np.mgrid[:160, :480][1] - 240.0)
    return patterns, photograph(patterns, {"columns": columns}, rng, light=150, ambient=ambient, gamma=gamma)


def test_a_gamma_beyond_what_can_be_undone_is_refused(rng):
    patterns, images = seen(3, rng, gamma=5.5)
    with pytest.raises(InputError, match=r"fringes of columns: 3 steps of 36 px are bent .* level\^3\.4 or more.* take 5 steps"):
        decode(images, patterns)


@pytest.mark.parametrize("gamma", [1.1, 1.8])
def test_a_gamma_that_a_small_object_hides_is_counted(rng, gamma):
    """An object of 40 x 40 px shows too few periods: by the gammas that agree as well, errors aren't beyond sigma."""
    parts = (Fringes(pitch=24, steps=3), Fringes(pitch=216, steps=3), Fringes(pitch=912, steps=3))
    patterns = Patterns(projector_size=(912, 480), unwrap="heterodyne", parts=parts)
    columns = 300 + 0.8 * np.mgrid[:120, :200][1]
    light = np.zeros(columns.shape)
    light[40:80, 80:120] = 200
    images = photograph(patterns, {"columns": columns}, rng, light=light, ambient=3, gamma=gamma)
    found = decode(images, patterns, noise=NOISE)
    ok = found.status == Status.OK
    z = (found.columns - columns)[ok] / found.sigma_columns[ok]
    assert ok.sum() > 1000 and 0.4 < z.std() < 1.1
    assert all(bend.sigma > 0.005 for bend in found.linearity.bends)


@pytest.mark.parametrize("steps", [3, 4])
def test_peaks_that_saturate_are_no_gamma(rng, steps):
    """White level 2 DN beyond full scale, linear light: pixels at the peaks, N times a period, are missing, the rest is good."""
    patterns = patterns_of((Fringes(pitch=18, steps=steps), CODE))
    columns = 639.5 + 0.9 * (np.mgrid[:160, :480][1] - 240.0) + 3 * np.sin(np.mgrid[:160, :480][0] / 20)
    images = photograph(patterns, {"columns": columns}, rng, light=249, ambient=8)
    found = decode(images, patterns)
    ok = found.status == Status.OK
    assert 0.05 < np.mean(found.status == Status.SATURATED) < 0.3
    assert (found.columns - columns)[ok].std() < 0.05  # 0.03; 0.3 where peaks are taken for a gamma
    assert not any("light isn't linear" in line for line in describe_decoding(patterns, found))


@pytest.mark.parametrize(("steps", "blur"), [(3, 0.5), (4, 0.5), (4, 1.0)])
def test_binary_fringes_are_no_gamma(rng, steps, blur):
    """Third harmonics of a square wave, undone or too strong for that: the way on is more defocus."""
    parts = (Fringes(pitch=16, steps=steps, waveform="binary", origin=640.5), GrayCode(pitch=16, bits=7, complementary=True))
    columns = 639.5 + 0.9 * (np.mgrid[:160, :320][1] - 160.0)
    images = photograph(patterns_of(parts), {"columns": columns}, rng, light=200, blur=blur)
    try:
        found = decode(images, patterns_of(parts))
        said = [line for line in describe_decoding(patterns_of(parts), found) if line.startswith("linearity")]
    except InputError as reason:
        said = [str(reason)]
    assert len(said) == 1 and "binary fringes" in said[0] and said[0].endswith("defocus the projector more, or take sine fringes")


@pytest.mark.parametrize(
    ("steps", "pitch", "blur", "period_px"),
    [(3, 24, 0.5, 40), (3, 60, 2, 90), (3, 24, 1, 40), (3, 24, 1, 14), (3, 60, 8, 90), (4, 60, 4, 90), (4, 60, 8, 90)],
)
def test_what_is_left_of_binary_fringes_is_counted(rng, steps, pitch, blur, period_px):
    """Harmonics that two terms don't undo: refused where the phase stands still, else in sigma, not too small nor too large."""
    bits = int(np.ceil(np.log2(1280 / pitch)))
    parts = (Fringes(pitch=pitch, steps=steps, waveform="binary"), GrayCode(pitch=pitch, bits=bits, complementary=True))
    u, v = np.arange(640), np.arange(200)[:, None]
    columns = 20 + u * pitch / period_px + 10 * np.sin(u / 300 + v / 200) + 0.03 * v
    images = photograph(patterns_of(parts), {"columns": columns}, rng, light=180, blur=blur)
    if blur < pitch / 25:
        with pytest.raises(InputError, match="bent by harmonics of binary fringes, by which phases can't be told"):
            decode(images, patterns_of(parts), noise=NOISE)
        return
    found = decode(images, patterns_of(parts), noise=NOISE)
    off = (found.columns - columns)[found.status == Status.OK]
    off = off[np.abs(off) < 3] - np.median(off)
    assert 0.6 < np.std(off) / np.sqrt(np.nanmean(found.sigma_columns**2)) < 1.4


def test_binary_fringes_of_few_pixels_are_said_to_hide_their_bend(rng):
    parts = (Fringes(pitch=24, steps=3, waveform="binary"), GrayCode(pitch=24, bits=6, complementary=True))
    columns = np.broadcast_to(30 + 3.0 * np.arange(400), (200, 400))
    found = decode(
        photograph(patterns_of(parts), {"columns": columns}, rng, light=180, blur=0.7), patterns_of(parts), noise=NOISE
    )
    assert any(
        "which periods of so few camera pixels don't show" in line for line in describe_decoding(patterns_of(parts), found)
    )


def test_clipped_black_is_named(rng):
    """Of 150 DN 30 subtracted: by the line of the bend with three steps; 100: in place of a wrong order with twelve."""
    patterns, images = seen(3, rng)
    found = decode(np.maximum(images, 38) - 38, patterns)
    said = [line for line in describe_decoding(patterns, found) if line.startswith("linearity   light isn't linear")]
    assert said and all("% of the samples are 0: is black clipped" in line for line in said)
    patterns, images = seen(12, rng)
    decode(images, patterns)
    with pytest.raises(InputError, match=r"do not follow the 12-step sequence: \d\d % of the samples are 0: is black clipped"):
        decode(np.maximum(images, 108) - 108, patterns)


def test_a_code_that_jumps_is_doubted_with_its_noise_where_that_is_assumed(rng):
    """Three steps don't show their noise, so that orders that jump may be a dark image's that a gamma spread."""
    for steps, doubted in ((3, True), (8, False)):
        patterns, images = seen(steps, rng)
        images[[steps + 3, steps + 4]] = images[[steps + 4, steps + 3]]
        with pytest.raises(InputError, match="fringe orders jump") as caught:
            decode(images, patterns)
        assert ("are dark pixels noisier" in str(caught.value)) == doubted
