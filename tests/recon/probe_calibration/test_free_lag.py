"""Is a lag found together with the probe, as sure as is said, and refused where the motion doesn't determine it?"""

from pathlib import Path

import numpy as np
import pytest

from recon.errors import InputError
from recon.probe_calibration import point_calibration, repeatability
from recon.session import probe_step
from recon.session.probe_step import Settings
from tests.recon import bscans, moving_phantoms, probe_motions

MADE = {"crossed_wires": moving_phantoms.over_crossing, "n_wires": moving_phantoms.over_rows}
POINTS = repeatability.five_points(bscans.SIZE)


def settings_of(rig, phantom):
    return Settings(rig=rig, capture=Path("drawn"), phantom=phantom, lag_s="free", tank_speed=1540.0, wire_radius_mm=0)


def calibrated(rig, phantom, seed, found=None):
    """The true lag, the one that is found, and the calibrations with it and with the true one."""
    rng = np.random.default_rng([seed, 7])
    lag_s = rng.uniform(-0.2, 0.2)
    sweep, frames = MADE[phantom](rig, lag_s, rng)
    settings = settings_of(rig, phantom)
    found = probe_step.find_lag(frames, sweep, settings)
    made = [
        probe_step.calibrate(probe_step.at_lag(frames, sweep, *lag, found.jitter_s, settings.noise), rig.probe, settings).result
        for lag in ((found.seconds, found.sigma_s), (lag_s, 0.0))
    ]
    return lag_s, found, [result.adjustment for result in made]


def away(rig, adjustment):
    """Errors : (5, 3) mm of the five points in the target's frame."""
    return adjustment.calibration.to_target(POINTS) - probe_motions.true_probe(rig).to_target(POINTS)


@pytest.mark.parametrize(("phantom", "bar_s"), [("crossed_wires", 0.002), pytest.param("n_wires", 0.006, marks=pytest.mark.slow)])
def test_a_lag_is_found_and_the_probe_is_as_good_as_with_the_true_one(phantom, bar_s, rig):
    """Of either sign, by clocks that jitter and drop frames; N-wires at 10 mm/s show it to 1.3 ms (1 sigma)."""
    lag_s, found, (free, known) = calibrated(rig, phantom, 1)
    assert abs(found.seconds - lag_s) < min(4 * found.sigma_s, bar_s)
    assert np.linalg.norm(away(rig, free), axis=1).max() < 1.1 * np.linalg.norm(away(rig, known), axis=1).max() + 0.05
    assert free.rms_mm < 1.02 * known.rms_mm


@pytest.mark.slow
@pytest.mark.parametrize(("phantom", "count"), [("crossed_wires", 5), ("n_wires", 2)])
def test_the_lag_is_as_sure_as_is_said(phantom, count, rig):
    """Mean squares within 4 sigma of those expected, over the lags and, for the places of the image's middle, over three axes."""
    squares, places = [], []
    for seed in range(count):
        lag_s, found, (free, _) = calibrated(rig, phantom, 10 + seed)
        squares.append(((found.seconds - lag_s) / found.sigma_s) ** 2)
        off, covariance = away(rig, free)[0], point_calibration.point_covariance(free.calibration, POINTS[:1])[0]
        places.append(off @ np.linalg.solve(covariance, off) / 3)
    assert np.mean(squares) < 1 + 4 * np.sqrt(2 / count)
    assert np.mean(places) < 1 + 4 * np.sqrt(2 / 3 / count)


@pytest.mark.slow
def test_jitter_is_measured(rig):
    """2 ms of the time stamps, by 170 frames at 60 mm/s, half of which show little of it."""
    _, found, (free, _) = calibrated(rig, "crossed_wires", 3)
    assert found.jitter_s * free.noise_factor == pytest.approx(moving_phantoms.JITTER_S, abs=0.0008)


def test_a_probe_at_rest_is_refused(rig, rng):
    """Noise of the poses alone moves it, which determines nothing."""
    sweep, frames = moving_phantoms.over_crossing(rig, 0.05, rng, rest=True)
    with pytest.raises(
        InputError, match=r"expected a motion that determines it to 0.005 s .*: keep moving .* or use measure-lag"
    ):
        probe_step.find_lag(frames, sweep, settings_of(rig, "crossed_wires"))


@pytest.mark.slow
def test_a_lag_beyond_the_search_is_refused(rig, rng):
    sweep, frames = moving_phantoms.over_crossing(rig, 0.8, rng)
    with pytest.raises(InputError, match=r"drawn: .*(expected the lag within|of lags from) -0.5 to 0.5 s"):
        probe_step.find_lag(frames, sweep, settings_of(rig, "crossed_wires"))


def test_a_lag_that_nobody_told_is_named(rig, rng):
    """Of frames that contradict each other without it; one that is right isn't."""
    sweep, frames = moving_phantoms.over_crossing(rig, 0.15, rng)
    settings = settings_of(rig, "crossed_wires").model_copy(update={"lag_s": None})
    late = probe_step.at_lag(frames, sweep, 0.0, 0.0, 0.0, settings.noise)
    assert probe_step.name_lag(late, sweep, settings) == "; with lag_s=0.15 they agree: give lag_s=free"
    right = settings.model_copy(update={"lag_s": 0.15})
    assert probe_step.name_lag(probe_step.at_lag(frames, sweep, 0.15, 0.0, 0.0, settings.noise), sweep, right) == ""
