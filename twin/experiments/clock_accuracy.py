"""Accuracy of the measured delay between scanner and cameras, from B-scans of a tank's bottom stamped by clocks of all kinds."""

import numpy as np
from numpy.typing import NDArray

from recon.model.tracks import Track
from recon.probe_calibration import latency
from recon.probe_calibration.latency import Lag
from scenes.catalogue import build_scene
from twin.evaluation.surface_errors import rms
from twin.experiments.experiment_setup import Figures, Setup
from twin.ultrasound import sweep_session
from twin.ultrasound.bscan import scans
from twin.ultrasound.echo_solids import body
from twin.ultrasound.probe_path import Bob
from twin.ultrasound.timed_sweep import Clocks, Plan, PoseNoise, plan

LAGS_S = np.linspace(0.0, 0.2, 5)
DRAWS = 12  # of the clocks' jitter, the dropped frames and the tracker's noise, at each lag
JITTER_S = 0.005
DROPPED = 0.1  # of the images, and of the poses
SEED = 11


def lags(setup: Setup, draws: int = DRAWS) -> Figures:
    """Error of the lag over all draws, and how often its interval of 95 % holds the truth."""
    still = Clocks(lag_s=0.0, scanner_jitter_s=0.0)
    made, array = body(build_scene({"kind": "tank"})), setup.scanners["water"]
    planned = sweep_session.plan_sweep(Bob(), setup.rig, made, array, still, PoseNoise(), SEED)
    depths = np.array([latency.bottom_depth(one.image) for one in scans(made, array, planned.truth.poses, SEED)])
    rng = np.random.default_rng(SEED)
    found = [(true, drawn(setup, planned, depths, true, rng)) for true in LAGS_S for _ in range(draws)]
    errors = np.array([one.seconds - true for true, one in found])
    return {
        "draws": len(found),
        "largest_ms": 1e3 * np.abs(errors).max(),
        "rms_ms": 1e3 * rms(errors),
        "predicted_ms": 1e3 * np.median([one.sigma_s for _, one in found]),
        "held": np.mean([one.interval_s[0] <= true <= one.interval_s[1] for true, one in found]),
    }


def drawn(setup: Setup, planned: Plan, depths: NDArray[np.float64], lag_s: float, rng: np.random.Generator) -> Lag:
    """The lag found where clocks, tracker and dropped frames are drawn anew; the images stay the same."""
    clocks = Clocks(lag_s=lag_s, scanner_jitter_s=JITTER_S)
    other = plan(setup.rig.probe, planned.truth, planned.truth.times, clocks, PoseNoise(), int(rng.integers(2**31)))
    shown, tracked = rng.random(len(depths)) > DROPPED, rng.random(len(other.track.times)) > DROPPED
    track = Track(other.track.times[tracked], other.track.poses[tracked])
    return latency.estimate(other.times[shown], depths[shown], track)
