"""Drift that a session shows is corrected, to what it says; no drift is left alone, and a pushed device isn't taken for drift."""

import numpy as np
import pytest
from scipy.stats import chi2

from recon.geometry import rigid
from recon.geometry.camera_jacobian import MOTION
from recon.model import circle_layout
from recon.model.calibration import DRIFT_PX, Calibration, Uncertainty
from recon.optical_calibration import uncertainty
from recon.rig_check import drift, optics_equations
from recon.rig_check.optics_equations import DeviceRows, points_by_light
from recon.session import drift_step
from recon.tracking.pose_fit import meet
from twin.experiments import drawn_check
from twin.optics.surface_session import calibration_of

COLUMNS, SIGMA_PX = (0,), 0.02


@pytest.fixture(scope="module")
def calibration(rig) -> Calibration:
    return calibration_of(rig)


def corrected(rig, calibration, true, rng, views=0):
    """The correction by vertical fringes, and views of the target."""
    film = drawn_check.drawn_film(true, calibration.cameras, rig.target, 0.008, rng, views) if views else None
    matches = drawn_check.drawn_matches(true, calibration.cameras, COLUMNS, SIGMA_PX, rng).some(slice(0, 300))
    return drift.estimate(calibration, film, matches, rig.target, 3e-4, DRIFT_PX), matches


def apart(cameras, true, matches):
    """Mean displacement, mm, of the skin by light along camera 1's axis, against both cameras; and the places."""
    places = points_by_light(matches.pixels, matches.first, COLUMNS, true)
    return drift.parting(cameras, true, places, COLUMNS)[:, 2].mean(), places


def parted(known, true, places):
    """Displacement of the skin along camera 1's axis, as the six coefficients : (6,) mm of a quadratic, and their covariance."""
    x, y = places[:, :2].T / 50
    quadratic = np.linalg.pinv(np.column_stack([np.ones_like(x), x, y, x**2, x * y, y**2]))
    slope = quadratic @ uncertainty.parting(known, places, COLUMNS)[:, 2]
    return quadratic @ drift.parting(known.cameras, true, places, COLUMNS)[:, 2], slope @ known.uncertainty.covariance @ slope.T


def test_drift_is_corrected_to_what_is_predicted(rig, calibration, rng):
    """Over 20 rigs skin and target part by 0.1 mm and more; corrected by 3 um as predicted.

    A variance of half or double the predicted one would be seen.
    """
    before, after, squared = [], [], []
    for _ in range(20):
        true = drawn_check.drawn_rig(calibration.cameras, drift.usual_drift(calibration.cameras, DRIFT_PX), rng)
        found, matches = corrected(rig, calibration, true, rng)
        assert (found.after.uncertainty.covariance == found.after.uncertainty.covariance.T).all()
        before.append(apart(calibration.cameras, true, matches)[0])
        mean, places = apart(found.after.cameras, true, matches)
        after.append(mean)
        left, covariance = parted(found.after, true, places)
        squared.append(left @ np.linalg.solve(covariance, left))
    assert np.std(before) > 0.1 and np.std(after) < 0.01
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 6 * len(squared))
    assert low < sum(squared) < high


def test_views_of_the_target_show_what_vertical_fringes_do_not(rig, calibration, rng):
    """How far camera 2 drifted across its epipolar lines: sigma of what parts skin and target along the fringes."""
    true = drawn_check.drawn_rig(calibration.cameras, drift.usual_drift(calibration.cameras, DRIFT_PX), rng)
    point, sigmas = np.array([[0.0, 0.0, 650.0]]), []
    for views in (0, 12):
        found, _ = corrected(rig, calibration, true, rng, views)
        slope = uncertainty.parting(found.after, point, COLUMNS)[0, 1]
        sigmas.append(np.sqrt(slope @ found.after.uncertainty.covariance @ slope))
    assert sigmas[0] > 0.0005 and sigmas[1] < 0.3 * sigmas[0]


def test_without_drift_nothing_is_harmed(rig, calibration, rng):
    """The correction is that of noise: micrometres, where usual drift parts skin and target by a tenth of a millimetre."""
    found, matches = corrected(rig, calibration, calibration.cameras, rng)
    assert found.size == 1 and found.surprise < 3
    assert abs(apart(found.after.cameras, calibration.cameras, matches)[0]) < 0.01


def test_larger_drift_is_as_large_as_it_is(rig, calibration):
    """The median of five rigs whose devices drifted four times as far, within a factor of two."""
    sizes = []
    for seed in range(5):
        rng = np.random.default_rng([7, seed])
        true = drawn_check.drawn_rig(calibration.cameras, drift.usual_drift(calibration.cameras, 4 * DRIFT_PX), rng)
        found, matches = corrected(rig, calibration, true, rng, 8)
        sizes.append(found.size)
        assert abs(apart(found.after.cameras, true, matches)[0]) < 0.02
    assert 2 < np.median(sizes) < 8


def test_a_pushed_camera_is_no_drift(rig, calibration, rng):
    """By 0.1 deg, 5.8 px: a hundred times the drift."""
    found, _ = corrected(rig, calibration, drawn_check.turned(calibration.cameras, rng, "cam2", 0.1), rng, 8)
    assert found.size > drift.LARGEST and found.surprise > 5


def test_mounts_move_the_devices_as_predicted(calibration, rng):
    """Motions of 2000 drawn mounts, camera 1's too, in camera 1's frame: variances and covariances to 6 standard deviations."""
    known, cameras = drift.usual_drift(calibration.cameras, DRIFT_PX), calibration.cameras
    sizes = DRIFT_PX * np.repeat([drift.TURN_PER_PX, drift.SHIFT_PER_PX], 3)
    steps = []
    for motion in rng.standard_normal((2000, 3, 6)) * sizes:
        first, *others = (rigid.moved(np.eye(4), step) for step in motion)
        for device, own in zip(("cam2", "projector"), others, strict=True):
            place = cameras[device].camera_from_world
            steps.append(rigid.difference(place, own @ place @ rigid.invert(first)))
    drawn = np.cov(np.reshape(steps, (2000, 12)), rowvar=False)
    names = [f"{device}.{name}" for device in ("cam2", "projector") for name in MOTION]
    at = [known.names.index(name) for name in names]
    expected = known.covariance[np.ix_(at, at)]
    spread = np.sqrt((np.outer(np.diag(expected), np.diag(expected)) + expected**2) / 2000)
    assert np.abs((drawn - expected) / spread).max() < 6


def test_a_target_of_known_lengths_tells_the_scale(rig, calibration):
    """By a microscope, to 0.002 mm of 25: 5e-5 in place of 3e-4, as predicted over ten rigs; one by cameras tells nothing."""
    target = rig.target.model_copy(update={"tolerance_mm": 0.002, "covariance_mm2": None})
    normal = []
    for seed in range(10):
        rng = np.random.default_rng([11, seed])
        wrong = drawn_check.drawn_rig(calibration.cameras, drift.calibration_uncertainty(calibration, 3e-4), rng)
        true = drawn_check.drawn_rig(wrong, drift.usual_drift(calibration.cameras, DRIFT_PX), rng)
        printed = circle_layout.with_lengths(
            target, rng.multivariate_normal(circle_layout.lengths(target), circle_layout.length_covariance(target))
        )
        film = drawn_check.drawn_film(true, calibration.cameras, printed, 0.008, rng, 24)
        found = drift.estimate(calibration, film, None, target, 3e-4, DRIFT_PX).after
        volume = uncertainty.working_volume(found, [620.0, 680.0])
        sigma = uncertainty.scale(found, "cam1", "cam2", volume)
        assert sigma < 8e-5
        seen = [true[name].project(volume) for name in ("cam1", "cam2")]
        places = meet([found.cameras[name] for name in ("cam1", "cam2")], seen)[0]
        modes = uncertainty.similarity_modes(volume)
        normal.append(np.linalg.lstsq(modes.reshape(-1, 7), (places - volume).ravel(), rcond=None)[0][-1] / sigma)
    assert chi2.ppf(1e-3, 10) < np.sum(np.square(normal)) < chi2.ppf(1 - 1e-3, 10)
    by_cameras = drift.estimate(calibration, film, None, drift_step.with_open_scale(target), 3e-4, DRIFT_PX).after
    assert uncertainty.scale(by_cameras, "cam1", "cam2", volume) > 2.9e-4


def test_points_that_are_far_off_are_left_out_though_motions_bend_to_them(rig, rng):
    """Rims, a thirtieth of the points at one side, by 2000 standard deviations: all of them, and of the others hardly any."""
    names = tuple(f"{device}.{name}" for device in ("cam2", "projector") for name in MOTION)
    places = np.sort(rng.uniform(-1, 1, 1000))
    wrong = places > np.quantile(places, 29 / 30)
    slopes = 1e5 * np.polynomial.chebyshev.chebvander(places, len(names) - 1)
    rows = DeviceRows(rng.standard_normal(1000) + 2000.0 * wrong, slopes, np.zeros((1000, len(rig.target.LENGTHS))))
    left = optics_equations.agreeing(rows, rig.target, Uncertainty(names, 1e-8 * np.eye(len(names))), names, 1)
    assert np.abs(left.residuals).max() < 100 and len(left.residuals) > 0.98 * np.count_nonzero(~wrong)


def test_fringes_along_both_axes_count_though_a_camera_has_turned(rig, calibration, rng):
    """By 0.02 deg: one of three equations of a point is off by 100 standard deviations, of nearly all points alike; of stray ones
    by 100 more.
    """
    known = drift.usual_drift(calibration.cameras, DRIFT_PX)
    names = optics_equations.parameters(known, list(calibration.cameras))
    for _ in range(8):
        true = drawn_check.turned(calibration.cameras, rng, "cam2", 0.02)
        matches = drawn_check.drawn_matches(true, calibration.cameras, (0, 1), SIGMA_PX, rng).some(slice(0, 300))
        matches.second[:9] += rng.choice([-2.0, 2.0], (9, 2))
        rows = optics_equations.of_fringes(matches, calibration.cameras, rig.target, names)
        left = optics_equations.agreeing(rows, rig.target, known, names, 3)
        assert 0.9 * 291 < len(left.residuals) / 3 <= 291
        assert not set(np.round(rows.residuals[:27], 6)) & set(np.round(left.residuals, 6))
