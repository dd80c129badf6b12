"""What the projector sends out: raster, gamma, black level, point spread."""

import mitsuba as mi
import numpy as np
import pytest

from recon.model.patterns import CentreLine, Fringes, GrayCode, Patterns, Uniform
from twin.optics.raster import MARGIN, OVERSAMPLING, Light, LightTable


@pytest.fixture
def patterns() -> Patterns:
    """Patterns along both axes, interleaved."""
    parts = (
        CentreLine(width=3),
        Fringes(axis="rows", pitch=10, steps=5),
        Fringes(pitch=12, steps=8),
        CentreLine(axis="rows"),
        Uniform(level=0.5),
    )
    return Patterns(projector_size=(1280, 800), unwrap="centre_line", parts=parts)


def looked_up(table: LightTable, pixels: np.ndarray) -> np.ndarray:
    return np.stack([np.asarray(value) for value in table.lookup(mi.Point2f(*np.float32(pixels.T)), mi.Bool(True))])


def test_lookup_is_the_pattern(rig, patterns, rng):
    """Without blur, the light at any place of a micromirror is that mirror's, in the sequence's order, for both axes."""
    device = rig.projector.model_copy(
        update={"gamma": 1.0, "contrast": 1e9, "lens": rig.projector.lens.model_copy(update={"blur_px": 0.0})}
    )
    mirrors = np.stack([rng.integers(0, 1280, 500), rng.integers(0, 800, 500)], axis=1)
    values = looked_up(LightTable.of(Light.of(patterns, device)), mirrors + rng.uniform(-0.45, 0.45, (500, 2)))
    expected = patterns.images()[:, mirrors[:, 1], mirrors[:, 0]]
    np.testing.assert_allclose(values, expected, atol=1 / 255)


def test_no_light_outside(rig, patterns):
    """Beyond the raster there is no light, not even the black level's."""
    outside = np.array([[-0.6, 400], [1279.6, 400], [640, -0.6], [640, 799.6]])
    assert (looked_up(LightTable.of(Light.of(patterns, rig.projector)), outside) == 0).all()


def test_gamma_for_grey_only(rig):
    """Grey levels pass the gamma, binary patterns don't; black is 1/contrast."""
    parts = (Fringes(pitch=16, steps=4), GrayCode(pitch=16, bits=7), Uniform(level=0.5))
    light = Light.of(Patterns(projector_size=(1280, 800), unwrap="gray", parts=parts), rig.projector)
    black = 1 / rig.projector.contrast
    assert light.profiles[-1][0] == pytest.approx(black + (1 - black) * (128 / 255) ** rig.projector.gamma, rel=1e-5)
    np.testing.assert_allclose(np.unique(light.profiles[6]), [black, 1], rtol=1e-5)


@pytest.mark.parametrize("blur", [0.4, 1.0])
def test_point_spread(blur):
    """One lit mirror comes out with its light kept and the variance of mirror and lens added: 1/12 + blur^2."""
    profile = np.zeros(64, np.float32)
    profile[30] = 1
    fine = Light((64, 64), ("columns",), (profile,), blur).fine_profiles("columns")[0]
    place = (np.arange(fine.size) + 0.5) / OVERSAMPLING - 0.5 - MARGIN
    assert fine.sum() / OVERSAMPLING == pytest.approx(1, rel=1e-4)
    assert (fine * place).sum() / fine.sum() == pytest.approx(30, abs=1e-4)
    assert (fine * (place - 30) ** 2).sum() / fine.sum() == pytest.approx(1 / 12 + blur**2, rel=0.01)
