"""The scanner's picture: nothing by default; compounding evens grains out as statistics say; each figure does what it names."""

import numpy as np
import pytest
from pydantic import ValidationError

from tests.twin.ultrasound.phantoms import down
from twin.ultrasound import bmode_image
from twin.ultrasound.beam import beam
from twin.ultrasound.bscan import scan, scans
from twin.ultrasound.medium import scatter
from twin.ultrasound.scanner_picture import Picture, mapped_greys, processed
from twin.ultrasound.sound_paths import follow
from twin.ultrasound.transducer import Transducer

CURVED = {"radius_mm": 60.0, "sector_deg": 30.0, "lines": 128}


def envelope(array, body, **picture):
    scanner = array.model_copy(update={"picture": Picture(**picture)})
    return scan(body, scanner, down(scanner, (0, 0, 600)), 1).envelope


def snr(found) -> float:
    """Mean over standard deviation in the middle of the image, of an envelope."""
    inner = found[120:330, 20:-20]
    return float(inner.mean() / inner.std())


def test_by_default_nothing_is_done():
    share = np.random.default_rng(0).random((40, 30), np.float32)
    assert processed(share, Picture(), 0.12, 0.12) is share and mapped_greys(share, Picture()) is share


def test_looks_even_out_grains_as_independent_ones_do(small, speckle):
    """Rayleigh's 1.91 of one; of n independent looks sqrt(n) times as much nearly; mean power stays."""
    one = envelope(small, speckle)
    bands, angles = envelope(small, speckle, bands=2), envelope(small, speckle, angles=3, steered_deg=12)
    assert snr(one) == pytest.approx(1.91, abs=0.2)
    assert 1.2 < snr(bands) / snr(one) < 1.5 and 1.35 < snr(angles) / snr(one) < 1.85
    for several in (bands, angles):
        power = [np.mean(found[120:330] ** 2) for found in (one, several)]
        assert power[1] / power[0] == pytest.approx(1, abs=0.2)


def test_lost_focus_widens_grains_and_keeps_their_power(small, speckle):
    scanner = small.model_copy(update={"aperture_rays": 3, "image_size": (200, 408)})
    pose = down(scanner, (0, 0, 600))
    whole, spread = follow(speckle, scanner, pose), beam(scanner)
    echoes = scatter(speckle, scanner, spread, whole, pose, 1)
    found = []
    for share in (1.0, 0.5, 0.0):
        lost = whole._replace(focus=np.full_like(whole.focus, share))
        found.append(bmode_image.envelope(echoes, scanner, spread, lost, np.random.default_rng(0))[120:330, 20:-20])
    powers = [float(np.mean(one**2)) for one in found]
    np.testing.assert_allclose(powers, powers[0], rtol=0.12)
    correlations = [np.corrcoef(one[:, :-4].ravel(), one[:, 4:].ravel())[0, 1] for one in found]
    assert correlations[0] < correlations[1] < correlations[2] and correlations[2] > correlations[0] + 0.2


def test_sliders_amplify_echoes_below_the_scale_too(small):
    """An echo 10 dB under black, and one at half of the scale, under sliders of -6 to 20 dB."""
    scanner = small.model_copy(update={"picture": Picture(sliders_db=(-6, 0, 20))})
    half, under = (np.full((41, 10), 10 ** ((level - small.gain_db) / 20), np.float32) for level in (-30, -70))
    np.testing.assert_allclose(bmode_image.shown(half, scanner)[[0, 20, 40], 0], [0.4, 0.5, 0.5 + 20 / 60], atol=1e-5)
    np.testing.assert_allclose(bmode_image.shown(under, scanner)[[20, 40], 0], [0, 10 / 60], atol=1e-5)


def test_grey_map_is_as_set():
    flat = np.full((41, 10), 0.5, np.float32)
    assert mapped_greys(flat, Picture(grey_map=(0, 0.2, 1)))[0, 0] == pytest.approx(0.2)


def test_smoothing_despeckling_and_edges():
    """A step among grains: smoothing blurs both, the guided filter the grains alone, and sharpening lifts the step."""
    rng = np.random.default_rng(1)
    step = np.where(np.arange(80) < 40, 0.3, 0.7).astype(np.float32)[None].repeat(80, axis=0)
    noisy = step + 0.05 * rng.standard_normal(step.shape).astype(np.float32)
    smooth, even, sharp = (
        processed(noisy, Picture(**one), 0.12, 0.12) for one in ({"smooth_mm": (0.4, 0.4)}, {"despeckle": 1.0}, {"edges": 1.0})
    )
    grains = [found[:, :30].std() for found in (noisy, smooth, even, sharp)]
    assert grains[1] < 0.3 * grains[0] and grains[2] < 0.4 * grains[0] and grains[3] > 1.3 * grains[0]
    rise = [(found[:, 42].mean() - found[:, 37].mean()) for found in (noisy, smooth, even)]
    assert rise[1] < 0.75 * rise[0] and rise[2] > 0.85 * rise[0]


def test_streaks_are_smoothed_along_themselves():
    """A slanted thin line among grains keeps most of its height; grains beside it lose half, and none turn where none run."""
    rng = np.random.default_rng(4)
    row, column = np.mgrid[:120, :120] * 0.12
    line = np.exp(-(((row - 7 - 0.3 * (column - 7)) / 0.15) ** 2)).astype(np.float32)
    noisy = 0.3 + 0.4 * line + 0.05 * rng.standard_normal(line.shape).astype(np.float32)
    found = processed(noisy, Picture(streaks=1.0), 0.12, 0.12)
    on, off = line > 0.9, line < 0.01
    assert found[on].mean() > 0.9 * noisy[on].mean() and found[on].std() < 0.75 * noisy[on].std()
    assert found[off].std() < 0.7 * noisy[off].std()
    level = np.full((40, 50), 0.4, np.float32)
    np.testing.assert_allclose(processed(level, Picture(streaks=1.0), 0.12, 0.12), level, atol=1e-6)


def test_lines_apart_are_interpolated_between():
    share = np.random.default_rng(2).random((20, 41), np.float32)
    found = processed(share, Picture(line_mm=0.5), 0.125, 0.12)
    np.testing.assert_allclose(found[:, ::4], share[:, ::4], atol=1e-6)
    np.testing.assert_allclose(found[:, 2:-2:4], (share[:, :-4:4] + share[:, 4::4]) / 2, atol=1e-6)


def test_persistence_keeps_a_share_of_the_picture_before(small, speckle):
    scanner = small.model_copy(update={"picture": Picture(persistence=0.5)})
    poses = np.stack([down(scanner, (0, y, 600)) for y in (0.0, 4.0, 8.0, 20.0)])
    kept = [one.image.astype(float) for one in scans(speckle, scanner, poses, 1)]
    alone = [one.image.astype(float) for one in scans(speckle, small, poses, 1)]
    assert (kept[0] == alone[0]).all() and (kept[3] == alone[3]).all()
    np.testing.assert_allclose(kept[2], alone[2] / 2 + alone[1] / 4 + alone[0] / 4, atol=1.0)


def test_clutter_fills_what_is_free_of_echoes(small):
    """Of its level deep in bright tissue, less beside that, and none above."""
    power = np.zeros((300, 96), np.float32)
    power[80:, :48] = 1
    scanner = small.model_copy(update={"picture": Picture(clutter_db=-20.0, clutter_mm=1.5)})
    smear = bmode_image._clutter(power, scanner, np.random.default_rng(0))
    inside = smear[180:, :20].mean()
    assert 10 * np.log10(inside) == pytest.approx(-20, abs=1)
    assert 0 < smear[180:, 60:80].mean() < inside / 10 and smear[:70].max() == 0


@pytest.mark.parametrize("wrong", [{"grey_map": (0.5, 0.2)}, {"grey_map": (0.5,)}, {"bands": 0}, {"jpeg": 101}, {"glow": 1}])
def test_nonsense_is_refused(wrong):
    with pytest.raises(ValidationError, match=next(iter(wrong))):
        Picture(**wrong)


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"aperture_rays": 2}, "aperture_rays: expected an odd number"),
        ({"picture": {"angles": 3, "steered_deg": 25}}, "steered_deg: expected less than 24.[0-9]"),
        ({"aperture_rays": 3, "curved": CURVED}, "aperture_rays: expected 1 for an array that isn't linear"),
        ({"picture": {"angles": 3}, "curved": CURVED}, "picture.angles: expected 1 for an array that isn't linear"),
    ],
)
def test_what_an_array_cannot_do_is_refused(wrong, reason):
    with pytest.raises(ValidationError, match=reason):
        Transducer(**wrong)
