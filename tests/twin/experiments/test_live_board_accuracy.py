"""Distances between calibrations, in their own standard deviations."""

import numpy as np
import pytest

from recon.estimation.covariance import root
from recon.model.calibration import Calibration, with_drift
from recon.optical_calibration import uncertainty
from twin.experiments.live_board_accuracy import apart
from twin.optics.surface_session import calibration_of


def test_calibrations_are_apart_by_their_standard_deviations(rig, rng):
    """Two draws of one covariance, forty times: squares of mean 1, each of five degrees of freedom or more."""
    cameras = calibration_of(rig).cameras
    true = Calibration(cameras, with_drift(None, cameras, 0.1))
    assert true.uncertainty is not None
    spread = root(true.uncertainty.covariance)
    drawn = [uncertainty.apply(true, spread @ rng.standard_normal(spread.shape[1])) for _ in range(80)]
    squares = [apart(first, second) ** 2 for first, second in zip(drawn[::2], drawn[1::2], strict=True)]
    assert np.mean(squares) == pytest.approx(1, abs=5 * np.sqrt(2 / 5 / 40))
    assert apart(true, true) < 1e-9
