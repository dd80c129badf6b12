"""Sequences that others project: defined by `Patterns` alone, they decode on any projector, camera size, depth and order."""

import numpy as np
import pytest

from recon.errors import InputError
from recon.model.patterns import Fringes, GrayCode, Patterns
from recon.structured_light.decode import Status, decode
from recon.structured_light.phase import Noise
from tests.recon.fringe_scenes import photograph

PROJECTORS = [(912, 1140), (1920, 1080)]
AXES = ("columns", "rows")


def cue(size, axis):
    """Three steps, and three of a period as long as the axis."""
    length = size[AXES.index(axis)]
    return [Fringes(axis=axis, pitch=length / 16, steps=3, first=-1), Fringes(axis=axis, pitch=length, steps=3, first=-1)]


def three_levels(size, axis):
    """Eight steps of 20 px, and two cues in whole multiples."""
    return [
        Fringes(axis=axis, pitch=20 * 8**k, steps=8 if k == 0 else 4) for k in range(3 if size[AXES.index(axis)] <= 1280 else 4)
    ]


def gray_pairs(size, axis):
    """Four steps of 16 px, and the code's bits with their inverses, from the axis's first pixel on."""
    bits = int(np.ceil(np.log2(size[AXES.index(axis)] / 16)))
    return [
        Fringes(axis=axis, pitch=16, steps=4, origin=-0.5),
        GrayCode(axis=axis, pitch=16, bits=bits, start=-0.5, inverted=True),
    ]


SEQUENCES = {"cue": (cue, "heterodyne"), "three_levels": (three_levels, "heterodyne"), "gray_pairs": (gray_pairs, "gray")}


def sequence(name, size, interleaved=False):
    parts, unwrap = SEQUENCES[name]
    columns, rows = (parts(size, axis) for axis in AXES)
    together = [part for pair in zip(columns, rows, strict=False) for part in pair] + columns[len(rows) :] + rows[len(columns) :]
    return Patterns(projector_size=size, unwrap=unwrap, parts=tuple(together if interleaved else columns + rows))


def across(size, shape):
    """Maps that show the whole of both axes, from end to end : (h, w) each."""
    v, u = np.mgrid[: shape[0], : shape[1]].astype(float)
    along = {"columns": u / (shape[1] - 1), "rows": v / (shape[0] - 1)}
    return {axis: -0.4 + along[axis] * (size[k] - 0.2) for k, axis in enumerate(AXES)}


def check(found, maps, least_share=0.98, border=3.0):
    """No order is wrong, little is lost, and errors are as predicted, but for the last pixels that blur continues."""
    for axis, value, sigma in (("columns", found.columns, found.sigma_columns), ("rows", found.rows, found.sigma_rows)):
        ok = np.isfinite(value)
        assert ok.mean() > least_share
        error = value[ok] - maps[axis][ok]
        assert np.abs(error).max() < 3  # px, of periods of 16 and more
        inner = (maps[axis][ok] > border) & (maps[axis][ok] < maps[axis].max() - border)
        z = (error / sigma[ok])[inner]
        assert np.abs(z).max() < 6
        assert abs(z.std() - 1) < 0.1  # rounding to 8 bits is no normal noise


@pytest.mark.parametrize("size", PROJECTORS, ids="{0[0]}x{0[1]}".format)
@pytest.mark.parametrize("name", SEQUENCES)
def test_the_whole_projector_decodes(rng, name, size):
    """Both axes from the first pixel to the last, on each projector, half of them interleaved; no order is wrong, and little is
    lost.
    """
    interleaved = (PROJECTORS.index(size) + list(SEQUENCES).index(name)) % 2
    patterns = sequence(name, size, bool(interleaved))
    maps = across(size, (480, 640))
    found = decode(photograph(patterns, maps, rng), patterns, noise=Noise(0.5, 0.033))
    check(found, maps, 0.85 if name == "gray_pairs" else 0.98)


@pytest.mark.parametrize("shape", [(1024, 1224), (211, 1031)], ids="{0[1]}x{0[0]}".format)
def test_any_camera_size(rng, shape):
    """Other cameras, twelve bits: the same light in finer steps. Only a crop of a large image's rows carries light."""
    patterns = sequence("cue", (1024, 768))
    maps = across((1024, 768), (min(shape[0], 200), shape[1]))
    images = photograph(patterns, maps, rng).astype(np.uint16) * 16
    whole = np.full((len(images), *shape), 128, np.uint16)
    whole[:, : images.shape[1]] = images
    found = decode(whole, patterns, bits=12, noise=Noise(0.5, 0.033).scaled(16))
    assert found.status.shape == shape
    assert (found.status[images.shape[1] :] == Status.DARK).all()
    assert np.mean(found.status[: images.shape[1]] == Status.OK) > 0.75
    assert np.nanmax(np.abs(found.columns[: images.shape[1]] - maps["columns"])) < 3


def test_three_steps_bridge_a_ratio_of_twenty_and_no_more(rng):
    """A cue's noise is magnified by the ratio of the periods: by 20 it is harmless, by 80 the order is a guess, and refused."""
    size, maps = (1280, 800), across((1280, 800), (240, 320))

    def of(pitch):
        parts = tuple(part for axis in AXES for part in (Fringes(axis=axis, pitch=p, steps=3) for p in (pitch, 1280)))
        return Patterns(projector_size=size, unwrap="heterodyne", parts=parts)

    check(decode(photograph(of(64), maps, rng), of(64)), maps)
    with pytest.raises(InputError, match=r"pitches 16, 1280 px leave [12]\.[0-9] sigma at .* a pitch in between"):
        decode(photograph(of(16), maps, rng), of(16))
    quiet = photograph(of(16), maps, rng, light=220.0, noise=Noise(0.1, 0.0))
    assert decode(quiet, of(16), noise=Noise(0.1, 0.0)).summary["ok"] > 0.9 * maps["columns"].size  # a camera without noise


def test_a_cue_stands_some_gamma(rng):
    """Three steps don't cancel the second harmonic: phases are bent by some per cent of a period, but no order is wrong."""
    patterns, maps = sequence("cue", (1024, 768)), across((1024, 768), (240, 320))
    found = decode(photograph(patterns, maps, rng, gamma=1.3), patterns)
    ok = np.isfinite(found.columns)
    assert ok.mean() > 0.97
    assert np.abs(found.columns - maps["columns"])[ok].max() < 3  # of 64 px


def test_fringes_that_run_the_other_way(rng):
    """`cos(phase - shift)` is the same sequence in reverse order, begun at 1 - steps."""
    size, maps = (1280, 800), across((1280, 800), (200, 300))
    patterns = Patterns(
        projector_size=size,
        unwrap="gray",
        parts=(Fringes(pitch=20, steps=4, first=1 - 4), GrayCode(pitch=20, bits=6, start=-0.5, inverted=True)),
    )
    images = photograph(patterns, maps, rng)
    x = np.arange(1280)
    backward = (1 + np.cos(2 * np.pi * (x - 639.5) / 20 - 2 * np.pi * np.arange(4)[:, None] / 4)) / 2
    assert patterns.parts[0].profiles(1280)[::-1] == pytest.approx(backward, abs=1e-6)
    assert np.nanmax(np.abs(decode(images, patterns).columns - maps["columns"])) < 3
