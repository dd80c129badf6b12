"""The choice of a distortion model by cross-validation."""

import itertools

import numpy as np
import pytest

from recon.geometry.camera_jacobian import DISTORTION
from recon.optical_calibration import distortion_selection
from recon.optical_calibration.bundle import Estimate
from recon.optical_calibration.distortion_selection import MODELS
from tests.recon.board_sets import BOARD, devices, observe, random_poses

LENSES = {
    "none": [],
    "radial1": [-0.11, 0, 0, 0],
    "decentred": [-0.11, 0.25, 0.002, -0.003],
    "rational": [0.3, -0.5, 0.001, 0.001, 3.0, 0.6, -2.0, 8.0],
}


@pytest.mark.parametrize("lens", LENSES)
def test_the_model_is_rich_enough_and_hardly_richer(rig, rng, lens):
    """Not a coefficient is missed that matters, and a quotient is only taken where there is one."""
    camera = rig.cam1.optics.model_copy(update={"distortion": tuple(LENSES[lens])}).camera()
    cameras = {"cam1": camera}
    poses = random_poses({**devices(rig), "cam1": camera}, 15, rng)
    seen = observe(cameras, poses, rng)
    chosen, scores = distortion_selection.choose(
        seen, Estimate(cameras, poses, BOARD.points()), "cam1", np.zeros_like(seen.pixels)
    )
    best = min(scores.values())
    assert scores[chosen] < 1.1 * best
    assert chosen == ("rational" if lens == "rational" else "brown")
    assert best == pytest.approx(0.01 * np.sqrt(2), rel=0.15)  # what is left out is predicted to the noise


def test_each_model_contains_the_one_before():
    names = list(MODELS.values())
    for simple, complex_ in itertools.pairwise(names):
        assert complex_[: len(simple)] == simple
        assert DISTORTION[: len(complex_)] == complex_
