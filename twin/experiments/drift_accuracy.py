"""Correction of drawn drift: what a session's fringes and films leave of it, and whether that is what they say."""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from recon.estimation.parameters import of_block
from recon.geometry.camera_jacobian import difference
from recon.model import circle_layout
from recon.model.calibration import DRIFT_PX, PRINT_SCALE, Calibration
from recon.optical_calibration import uncertainty
from recon.rig_check import drift
from recon.rig_check.ball_bar import Bars
from recon.rig_check.drift import Drift
from recon.rig_check.optics_equations import CAMERAS, PROJECTOR, points_by_light
from recon.tracking.pose_fit import meet
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
APART_MM = (50.0, 100.0)  # of two points of the skin whose distance is measured
DEPTHS_MM = (620.0, 680.0)  # of the volume, whose scale is judged
MICROSCOPE_MM = 0.002  # standard deviation of a target's lengths
BAR_MM, BAR_SIGMA_MM, BALL_MM = 150.0, 0.002, 25.4  # distance of a bar's balls, its standard deviation, and their diameter
BARS = np.array(  # (5, 2, 3) mm, ends of the bar: in the middle, near, far, upright, and tilted
    [
        [[-75.0, 0, 650], [75, 0, 650]],
        [[-75.0, 0, 615], [75, 0, 615]],
        [[-75.0, 0, 700], [75, 0, 700]],
        [[0.0, -75, 690], [0, 75, 690]],
        [[-60.0, 0, 605], [60, 0, 695]],
    ]
)
PLACES = {"a ball bar in one place": 1, "a ball bar in five places": 5}
KINDS = ("uncorrected", "corrected", "new")  # calibrations: as it was, corrected by the session, and made anew that day
LEAST = 1e-9  # variance of a principal axis of the correlation, below which rounding decides


KnownLength = Literal["the print", "a ball bar in one place", "a ball bar in five places", "a target under a microscope"]


class Errors(NamedTuple):
    """Of the skin, as a calibration measures it."""

    apart_mm: float  # mean displacement along camera 1's axis against both cameras
    sigma_mm: float  # of it, as predicted
    skin_mm: float  # RMS displacement in camera 1's frame
    shape_mm: float  # RMS displacement less the rigid motion that fits best
    distance_mm: float  # RMS error of distances of 50 to 100 mm
    distance_ppm: float  # of these, relative


class Outcome(NamedTuple):
    """Of one drawn session."""

    inside: bool  # what it shows of the devices, within its 95 % region
    errors: tuple[Errors, Errors, Errors]  # of KINDS
    size: float
    surprise: float


def sessions(
    setup: Setup,
    sessions: int = 200,
    times: float = 1.0,
    views: int = VIEWS,
    fringes: bool = True,
    scale: float = PRINT_SCALE,
    life: Literal["ideal", "lifelike"] = "lifelike",
) -> Figures:
    """Figures over sessions of a rig that was calibrated once, and drifted anew in each.

    times : drift over the usual one
    views : of the target; with `fringes`, what a session shows
    scale : relative standard deviation of the board's scale
    life : conditions under which board and target were printed
    """
    optics = drawn_session.calibrated_optics(setup.rig, setup.conditions(life), Noise(), Poses(), SEED)
    found = [session(setup, optics, times, views, fringes, scale, life, k) for k in range(sessions)]
    apart, sigma, *rms = np.array([one.errors for one in found]).transpose(2, 0, 1)
    figures = {
        "sessions": sessions,
        "times": times,
        "views": views,
        "inside_percent": 100 * float(np.mean([one.inside for one in found])),
        "alarms_percent": 100 * float(np.mean([one.size > drift.LARGEST for one in found])),
        "size_median": float(np.median([one.size for one in found])),
        "beyond_percent": 100 * float(np.mean(np.abs(apart[:, 1]) > 3 * sigma[:, 1])),
    }
    for k, name in enumerate(KINDS):
        figures |= {
            f"apart_rms_mm_{name}": float(np.sqrt(np.mean(apart[:, k] ** 2))),
            f"apart_worst_mm_{name}": float(np.abs(apart[:, k]).max()),
            f"apart_over_sigma_{name}": float(np.mean((apart[:, k] / sigma[:, k]) ** 2)),
        }
        sizes = {"skin_rms_mm": rms[0], "shape_rms_mm": rms[1], "distance_rms_mm": rms[2], "distance_ppm": rms[3]}
        figures |= {f"{size}_{name}": float(np.sqrt(np.mean(errors[:, k] ** 2))) for size, errors in sizes.items()}
    over = {size: figures[f"{size}_rms_mm_corrected"] / figures[f"{size}_rms_mm_new"] for size in ("apart", "skin", "shape")}
    return figures | {f"{size}_over_new": ratio for size, ratio in over.items()}


def session(
    setup: Setup,
    optics: Calibration,
    times: float,
    views: int,
    fringes: bool,
    scale: float,
    life: Literal["ideal", "lifelike"],
    k: int,
) -> Outcome:
    """Draw the calibration's error, drift, skin and target, and correct; and draw the error of a new calibration."""
    rng = np.random.default_rng([SEED, k])
    calibrated, usual = drift.calibration_uncertainty(optics, scale), drift.usual_drift(optics.cameras, times * DRIFT_PX)
    once = drawn_check.drawn_rig(optics.cameras, calibrated, rng)
    true = drawn_check.drawn_rig(once, usual, rng)
    printed = conditions.printed(setup.rig.target, setup.conditions(life).target, int(rng.integers(2**31)))
    film = drawn_check.drawn_film(true, optics.cameras, printed, Noise().circle_px, rng, views) if views else None
    matches = drawn_check.drawn_matches(true, optics.cameras, COLUMNS, Noise().column_px, rng) if fringes else None
    found = drift.estimate(optics, film, matches, setup.rig.target, scale, DRIFT_PX)
    points = drawn_check.drawn_matches(true, true, COLUMNS, 1e-6, rng) if matches is None else matches
    places = points_by_light(points.pixels, points.first, points.axes, true)
    before, new = Calibration(optics.cameras, found.prior), drawn_check.drawn_rig(true, calibrated, rng)
    errors = [_errors(each, true, places, rng) for each in (before, found.after, Calibration(new, calibrated))]
    return Outcome(distance(found, true) < 1, (errors[0], errors[1], errors[2]), found.size, found.surprise)


def _errors(calibration: Calibration, true: Devices, places: Array, rng: np.random.Generator) -> Errors:
    """Errors of places : (n, 3) mm, which the true devices see."""
    cameras, known = calibration.cameras, calibration.uncertainty
    assert known is not None
    shown = true[PROJECTOR].project(places)[:, list(COLUMNS)]
    moved = points_by_light(true["cam1"].project(places), shown, COLUMNS, cameras) - places
    slope = uncertainty.parting(calibration, places, COLUMNS)[:, 2].mean(axis=0)
    modes = uncertainty.rigid_modes(places).reshape(-1, 6)
    bent = moved.ravel() - modes @ np.linalg.lstsq(modes, moved.ravel())[0]
    pairs = rng.integers(len(places), size=(len(places), 2))
    way = np.diff(places[pairs], axis=1)[:, 0]
    length = np.linalg.norm(way, axis=1)
    some = (length > APART_MM[0]) & (length < APART_MM[1])
    longer = np.linalg.norm(way + np.diff(moved[pairs], axis=1)[:, 0], axis=1)[some] - length[some]
    return Errors(
        apart_mm=float(np.mean(drift.parting(cameras, true, places, COLUMNS)[:, 2])),
        sigma_mm=float(np.sqrt(slope @ known.covariance @ slope)),
        skin_mm=_rms(np.linalg.norm(moved, axis=1)),
        shape_mm=_rms(np.linalg.norm(bent.reshape(-1, 3), axis=1)),
        distance_mm=_rms(longer),
        distance_ppm=1e6 * _rms(longer / length[some]),
    )


def _rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def scales(setup: Setup, by: KnownLength, sessions: int = 100) -> Figures:
    """Errors of the scale over sessions of drifted rigs, by fringes on the skin and a known length."""
    optics = drawn_session.calibrated_optics(setup.rig, setup.conditions("lifelike"), Noise(), Poses(), SEED)
    measured = setup.rig.target.model_copy(update={"tolerance_mm": MICROSCOPE_MM, "covariance_mm2": None})
    found = []
    for k in range(sessions):
        rng = np.random.default_rng([SEED, 1, k])
        once = drawn_check.drawn_rig(optics.cameras, drift.calibration_uncertainty(optics, PRINT_SCALE), rng)
        true = drawn_check.drawn_rig(once, drift.usual_drift(optics.cameras, DRIFT_PX), rng)
        matches = drawn_check.drawn_matches(true, optics.cameras, COLUMNS, Noise().column_px, rng)
        film = bars = None
        if by == "a target under a microscope":
            errors = rng.multivariate_normal(np.zeros(len(measured.LENGTHS)), circle_layout.length_covariance(measured))
            printed = circle_layout.with_lengths(measured, circle_layout.lengths(measured) + errors)
            film = drawn_check.drawn_film(true, optics.cameras, printed, Noise().circle_px, rng, VIEWS)
        if by in PLACES:
            seen = (drawn_check.drawn_bar(true, ends, BALL_MM, Noise().column_px, rng) for ends in BARS[: PLACES[by]])
            bars = Bars(tuple(seen), BAR_MM + BAR_SIGMA_MM * rng.standard_normal(), BAR_SIGMA_MM)
        after = drift.estimate(optics, film, matches, measured, PRINT_SCALE, DRIFT_PX, bars).after
        volume = uncertainty.working_volume(after, DEPTHS_MM)
        pair = [cameras[name] for cameras in (after.cameras, true) for name in CAMERAS]
        moved = meet(pair[:2], [camera.project(volume) for camera in pair[2:]])[0] - volume
        error = np.linalg.lstsq(uncertainty.similarity_modes(volume).reshape(-1, 7), moved.ravel())[0][-1]
        found.append((error, uncertainty.scale(after, *CAMERAS, volume)))
    error, sigma = np.array(found).T
    return {
        "sessions": sessions,
        "rms_ppm": 1e6 * _rms(error),
        "sigma_ppm": 1e6 * float(np.median(sigma)),
        "over_sigma": float(np.mean((error / sigma) ** 2)),
    }


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
