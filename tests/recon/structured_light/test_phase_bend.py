"""Three and four steps under a gamma that nobody knows: measured on the fringes, undone, counted in sigma, and said."""

import numpy as np
import pytest

from recon.model.patterns import CentreLine, Fringes, GrayCode, Patterns
from recon.structured_light.decode import Status, decode
from recon.structured_light.surface_figures import describe_decoding
from tests.recon.fringe_scenes import photograph

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


def test_too_few_periods_to_see_a_gamma_are_said(rng):
    """Two periods on a wall: three steps are bent, and nothing shows by how much."""
    patterns = Patterns(
        projector_size=(1280, 800), unwrap="gray", parts=(Fringes(pitch=320, steps=3), GrayCode(pitch=320, bits=2))
    )
    columns = 639.5 + 1.4 * (np.mgrid[:160, :480][1] - 240.0)
    found = decode(photograph(patterns, {"columns": columns}, rng, light=150), patterns)
    assert any("too few periods" in line for line in describe_decoding(patterns, found))
