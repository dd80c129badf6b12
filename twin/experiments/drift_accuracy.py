"""Correction of drawn drift: what a session's fringes and films leave of it, and whether that is what they say."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from recon.estimation.parameters import of_block
from recon.geometry.camera_jacobian import difference
from recon.model.calibration import DRIFT_PX, PRINT_SCALE, Calibration
from recon.optical_calibration import uncertainty
from recon.rig_check import drift
from recon.rig_check.drift import Drift
from recon.rig_check.optics_equations import PROJECTOR, Matches, points_by_light
from scenes.board_poses import Config as Poses
from twin import conditions
from twin.experiments import drawn_check, drawn_session
from twin.experiments.drawn_check import Devices
from twin.experiments.drawn_session import Noise
from twin.experiments.experiment_setup import Figures, Setup

Array = NDArray[np.float64]

SEED = 3046
VIEWS = 24  # of the target, as many as `sonotwin correct-optics` takes
COLUMNS = (0,)  # axes of the fringes
LEAST = 1e-9  # variance of a principal axis of the correlation, below which rounding decides


class Outcome(NamedTuple):
    """Of one drawn session."""

    inside: bool  # what it shows of the devices, within its 95 % region
    apart_mm: Array  # (2,) mean displacement of the skin along camera 1's axis against both cameras: uncorrected, corrected
    sigma_mm: Array  # (2,) of these, as predicted
    skin_mm: Array  # (2,) RMS displacement of the skin itself in camera 1's frame: uncorrected, corrected
    size: float
    surprise: float


def sessions(setup: Setup, sessions: int = 200, times: float = 1.0, views: int = VIEWS, fringes: bool = True) -> Figures:
    """Figures over sessions of a rig that was calibrated once, and drifted anew in each.

    times : drift over the usual one
    views : of the target; with `fringes`, what a session shows
    """
    life = setup.conditions("lifelike")
    optics = drawn_session.calibrated_optics(setup.rig, life, Noise(), Poses(), SEED)
    found = [session(setup, optics, times, views, fringes, k) for k in range(sessions)]
    apart, sigma, skin = (np.array([getattr(one, name) for one in found]) for name in ("apart_mm", "sigma_mm", "skin_mm"))
    figures = {
        "sessions": sessions,
        "times": times,
        "views": views,
        "inside_percent": 100 * float(np.mean([one.inside for one in found])),
        "alarms_percent": 100 * float(np.mean([one.size > drift.LARGEST for one in found])),
        "size_median": float(np.median([one.size for one in found])),
        "beyond_percent": 100 * float(np.mean(np.abs(apart[:, 1]) > 3 * sigma[:, 1])),
    }
    for k, name in enumerate(("uncorrected", "corrected")):
        figures |= {
            f"apart_rms_mm_{name}": float(np.sqrt(np.mean(apart[:, k] ** 2))),
            f"apart_worst_mm_{name}": float(np.abs(apart[:, k]).max()),
            f"apart_over_sigma_{name}": float(np.mean((apart[:, k] / sigma[:, k]) ** 2)),
            f"skin_rms_mm_{name}": float(np.sqrt(np.mean(skin[:, k] ** 2))),
        }
    return figures


def session(setup: Setup, optics: Calibration, times: float, views: int, fringes: bool, k: int) -> Outcome:
    """Draw the calibration's error, drift, skin and target, and correct."""
    rng = np.random.default_rng([SEED, k])
    calibrated, usual = drift.calibration_uncertainty(optics, PRINT_SCALE), drift.usual_drift(optics.cameras, times * DRIFT_PX)
    once = drawn_check.drawn_rig(optics.cameras, calibrated, rng)
    true = drawn_check.drawn_rig(once, usual, rng)
    printed = conditions.printed(setup.rig.target, setup.conditions("lifelike").target, int(rng.integers(2**31)))
    film = drawn_check.drawn_film(true, optics.cameras, printed, Noise().circle_px, rng, views) if views else None
    matches = drawn_check.drawn_matches(true, optics.cameras, COLUMNS, Noise().column_px, rng) if fringes else None
    found = drift.estimate(optics, film, matches, setup.rig.target, PRINT_SCALE, DRIFT_PX)
    points = drawn_check.drawn_matches(true, true, COLUMNS, 1e-6, rng) if matches is None else matches
    return _compared(found, true, points)


def _compared(found: Drift, true: Devices, matches: Matches) -> Outcome:
    places = points_by_light(matches.pixels, matches.first, matches.axes, true)
    apart, sigma, skin = [], [], []
    for calibration in (Calibration(found.before.cameras, found.prior), found.after):
        cameras = calibration.cameras
        shown = true[PROJECTOR].project(places)[:, list(COLUMNS)]
        by_light = points_by_light(true["cam1"].project(places), shown, COLUMNS, cameras)
        apart.append(float(np.mean(drift.parting(cameras, true, places, COLUMNS)[:, 2])))
        assert calibration.uncertainty is not None
        slope = uncertainty.parting(calibration, places, COLUMNS)[:, 2].mean(axis=0)
        sigma.append(float(np.sqrt(slope @ calibration.uncertainty.covariance @ slope)))
        skin.append(float(np.sqrt(np.mean(np.sum((by_light - places) ** 2, axis=1)))))
    inside = distance(found, true) < 1
    return Outcome(inside, np.array(apart), np.array(sigma), np.array(skin), found.size, found.surprise)


def distance(found: Drift, true: Devices) -> float:
    """Squared distance of the true devices from the corrected ones, over that of the 95 % region's border."""
    known = found.after.uncertainty
    assert known is not None
    step = np.zeros(len(known.names))
    for device, camera in found.after.cameras.items():
        at, short = of_block(known.names, device)
        step[at] = difference(camera, true[device], short)
    spread = np.sqrt(np.diag(known.covariance))
    variances, axes = np.linalg.eigh(known.covariance / np.outer(spread, spread))
    shown = variances > LEAST
    normal = (axes.T @ (step / spread))[shown] / np.sqrt(variances[shown])
    return float(normal @ normal / chi2.ppf(0.95, shown.sum()))
