"""Are the figures of a measured target those of its circles and of its bow?"""

import numpy as np

from recon.target_calibration import target_figures
from recon.target_calibration.target_bundle import Adjusted, Noise
from tests.recon.target_calibration import target_pairs


def test_figures_and_lines(rig, rng):
    pairs = target_pairs.many((rig.cam1.optics.camera(), rig.cam2.optics.camera()), rig.target, 4, rng)
    target = rig.target.model_copy(update={"c1_mm": 25.1, "c2_aside_mm": -0.05, "curvature_per_m": (0.4, 0.0, -0.2)})
    covariance = np.diag([0.01, 0.02, 0.03, 0.04, 0.1, 0.1, 0.1]) ** 2
    adjusted = Adjusted(target, covariance, Noise(1.2, 0.5), 0.011, 0.02, np.array([True, True, False, True]), tuple(pairs))
    figures = target_figures.measure(adjusted, rig.target)
    assert (figures["pairs"], figures["pairs_used"]) == (4, 3)
    assert figures["sigma_c2_aside_mm"] == 0.02 and figures["design_c1_mm"] == 25
    assert np.isclose(figures["bow_across_mm"], 0.4e-3 * 60**2 / 8) and np.isclose(figures["bow_along_mm"], -0.2e-3 * 65**2 / 8)
    lines = list(target_figures.describe(figures, rig.target))
    assert lines[0] == "adjust      3 of 4 poses; residuals of centres 0.0110 px, 1.20 times the predicted noise"
    assert lines[1] == "c1          25.1000 ± 0.0100 mm, by design 25: +100 um"
    assert lines[2].startswith("c2 aside    -0.0500 ± 0.0200 mm, by design 0: -50 um")
    assert lines[5] == "bow         +0.180 mm across the board, -0.106 mm along it"
