"""The joint adjustment: right, efficient, and honest about how sure it is."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from recon.estimation.equations import Step, Undetermined
from recon.estimation.levenberg_marquardt import Descent, Unreachable
from recon.geometry import rigid
from recon.geometry.board_shape import Tolerances
from recon.geometry.camera_jacobian import MATRIX
from recon.geometry.lens_domain import is_one_to_one
from recon.geometry.usual_lenses import largest
from recon.model.calibration import Calibration
from recon.optical_calibration import adjustment, optical_checks
from recon.optical_calibration.adjustment import adjust, free_parameters
from recon.optical_calibration.bundle import Estimate, Problem, linear_system, move
from recon.optical_calibration.distortion_selection import MODELS
from recon.optical_calibration.joint_calibration import deviation
from tests.recon.board_sets import BOARD, DEVICES, devices, observe, random_poses

SETS = 4
LENS = dict.fromkeys(DEVICES, ("k1", "k2", "p1", "p2"))


def perturbed(cameras, poses, rng):
    """A start some pixels and millimetres off."""
    moved = {
        name: replace(camera, matrix=camera.matrix + np.diag([*rng.normal(0, 10, 2), 0])) for name, camera in cameras.items()
    }
    poses = poses.copy()
    poses[:, :3, 3] += rng.normal(0, 1, (len(poses), 3))
    return Estimate(moved, poses, BOARD.points())


def normalised_errors(found, cameras):
    """Each parameter's error over its predicted standard deviation."""
    return deviation(found, Calibration(cameras)) / np.sqrt(np.diag(found.uncertainty.covariance))


def drawn_board(tolerances, rng):
    """A board as its tolerances allow."""
    errors = np.linalg.cholesky(tolerances.covariance(BOARD.points()) + 1e-12 * np.eye(132)) @ rng.standard_normal(132)
    return BOARD.points() + errors.reshape(-1, 3)


def squared_error(found, cameras):
    """Normalised estimation error squared, and the number of parameters."""
    error = deviation(found, Calibration(cameras))
    return error @ np.linalg.solve(found.uncertainty.covariance, error), len(error)


def test_without_noise_the_truth_is_found(rig, rng):
    cameras = devices(rig)
    poses = random_poses(cameras, 8, rng)
    quiet = dict.fromkeys(DEVICES, 0.0)
    seen = observe(cameras, poses, rng, noise=quiet)
    found = adjust(seen, perturbed(cameras, poses, rng), free_parameters(DEVICES, LENS))
    for name in DEVICES:
        np.testing.assert_allclose(found.calibration.cameras[name].matrix, cameras[name].matrix, atol=1e-4)
        np.testing.assert_allclose(found.calibration.cameras[name].camera_from_world, cameras[name].camera_from_world, atol=1e-5)
    np.testing.assert_allclose(found.poses, poses, atol=1e-5)
    assert np.abs(found.residuals).max() < 1e-6


@pytest.mark.parametrize("claimed", [0.5, 3.0])
def test_the_covariance_is_honest_whatever_noise_was_claimed(rig, rng, claimed):
    """Normalised estimation error squared over the sets against chi-square (99.9 %), and the noise as it is."""
    cameras = devices(rig)
    total, degrees = 0.0, 0
    for _ in range(SETS):
        poses = random_poses(cameras, 10, rng)
        noise = {"cam1": 0.01, "cam2": 0.02, "projector": 0.005}
        seen = observe(cameras, poses, rng, noise=noise, claimed={name: claimed * value for name, value in noise.items()})
        found = adjust(seen, Estimate(cameras, poses, BOARD.points()), free_parameters(DEVICES, LENS))
        error, count = squared_error(found.calibration, cameras)
        total, degrees = total + error, degrees + count
        np.testing.assert_allclose([claimed * factor for factor in found.noise.values()], 1, atol=0.15)
    low, high = chi2.ppf([0.0005, 0.9995], degrees)
    assert low < total < high


def test_outliers_are_named_and_do_no_harm(rig, rng):
    cameras = devices(rig)
    poses = random_poses(cameras, 12, rng)
    seen = observe(cameras, poses, rng)
    spoilt = rng.random(seen.seen.shape) < 0.02
    pixels = seen.pixels + np.where(spoilt, 1.0, 0.0)[..., None] * rng.choice([-1, 1], (*spoilt.shape, 2)) * 0.5
    found = adjust(replace(seen, pixels=pixels), Estimate(cameras, poses, BOARD.points()), free_parameters(DEVICES, LENS))
    assert found.outliers[..., :2][spoilt[..., :2]].all()
    assert np.count_nonzero(found.outliers & ~spoilt & ~spoilt[..., :1]) == 0  # a point of camera 1 takes the projector's along
    error, count = squared_error(found.calibration, cameras)
    assert error < chi2.ppf(0.999, count)


def test_points_that_a_device_does_not_see_are_left_out(rig, rng):
    cameras = devices(rig)
    poses = random_poses(cameras, 12, rng)
    seen = observe(cameras, poses, rng)
    hidden = rng.random(seen.seen.shape) < 0.2
    hidden[3, :, 1] = True
    partly = replace(seen, pixels=np.where(hidden[..., None], np.nan, seen.pixels))
    found = adjust(partly, Estimate(cameras, poses, BOARD.points()), free_parameters(DEVICES, LENS))
    assert (np.isnan(found.residuals).all(axis=-1) == hidden).all()
    error, count = squared_error(found.calibration, cameras)
    assert error < chi2.ppf(0.999, count)
    np.testing.assert_allclose(list(found.noise.values()), 1, atol=0.15)


def test_misjudged_noise_neither_moves_the_end_nor_takes_long(rig, rng, monkeypatch):
    """A camera without its distortion misses by many times the noise: the noise is found, and the minimum that goes with it."""
    cameras = {"cam1": devices(rig)["cam1"]}
    poses = random_poses(devices(rig), 12, rng)
    seen, start = observe(cameras, poses, rng), Estimate(cameras, poses, BOARD.points())
    ideal = replace(start, cameras={"cam1": replace(cameras["cam1"], distortion=np.zeros(0))})
    free, evaluations = free_parameters(["cam1"], {"cam1": ()}), []

    def counted(*arguments, **options):
        evaluations.append(arguments)
        return linear_system(*arguments, **options)

    monkeypatch.setattr(adjustment, "linear_system", counted)
    found = adjust(seen, ideal, free)
    assert found.noise["cam1"] > 5 and len(evaluations) < 40
    known = adjust(replace(seen, covariance=seen.covariance * found.noise["cam1"] ** 2), found.estimate, free)
    apart = deviation(found.calibration, known.calibration) / np.sqrt(np.diag(known.calibration.uncertainty.covariance))
    assert np.abs(apart).max() < 0.02 and known.noise["cam1"] == pytest.approx(1, abs=0.01)


def test_a_step_to_a_camera_that_can_not_be_is_unreachable(rig, rng):
    """A focal length below zero, and values that aren't finite; a longer focal length is one that can be."""
    cameras = devices(rig)
    poses = random_poses(cameras, 2, rng)
    seen, start = observe(cameras, poses, rng), Estimate(cameras, poses, BOARD.points())
    problem = Problem(seen, np.zeros_like(seen.pixels), free_parameters(DEVICES, LENS))
    step, still = np.zeros(len(problem.names)), np.zeros((2, 6))
    fy = problem.names.index("projector.fy")
    for change in (-2 * cameras["projector"].matrix[1, 1], np.nan, -np.inf):
        step[fy] = change
        with pytest.raises(Unreachable):
            move(problem, start, Step(step, still))
    step[fy] = 10.0
    assert move(problem, start, Step(step, still)).cameras["projector"].matrix[1, 1] == cameras["projector"].matrix[1, 1] + 10


@pytest.mark.parametrize(("measured", "noise", "converged"), [(1.0, 1.0, True), (2.0, 1024.0, False), (0.0, 1e-3, True)])
def test_the_noise_converges_too(measured, noise, converged, rig, rng, monkeypatch):
    """Noise that doubles with each round isn't what the last estimate was weighed by; where there is none, it has a floor."""
    cameras = devices(rig)
    poses = random_poses(cameras, 2, rng)
    seen = observe(cameras, poses, rng)
    problem = Problem(seen, np.zeros_like(seen.pixels), free_parameters(DEVICES, LENS))
    start = Estimate(cameras, poses, BOARD.points())
    monkeypatch.setattr(adjustment, "_descend", lambda *_: Descent(start, None, None, True))
    monkeypatch.setattr(adjustment, "_measured_noise", lambda *_: np.full(3, measured))
    found = adjustment.fit(problem, start)
    assert found.converged is converged and found.noise == pytest.approx(noise)


def test_too_few_sightings_are_refused(rig, rng):
    cameras = devices(rig)
    poses = random_poses(cameras, 2, rng)
    seen = observe(cameras, poses, rng)
    sparse = replace(seen, pixels=np.where((np.arange(44) % 11 == 0)[:, None, None], seen.pixels, np.nan))
    with pytest.raises(Undetermined, match="fewer observations than unknowns"):
        adjust(sparse, Estimate(cameras, poses, BOARD.points()), free_parameters(DEVICES, LENS))


def test_a_lens_that_is_hardly_determined_is_said_to_be(rig, rng):
    """Six radial coefficients on three poses: the covariance stays one, and says that they are unknown."""
    cameras = devices(rig)
    poses = random_poses(cameras, 3, rng)
    seen = observe(cameras, poses, rng)
    rich = dict.fromkeys(DEVICES, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"))
    found = adjust(seen, Estimate(cameras, poses, BOARD.points()), free_parameters(DEVICES, rich)).calibration
    assert np.linalg.eigvalsh(found.uncertainty.covariance).min() >= -1e-9 * np.abs(found.uncertainty.covariance).max()
    assert (np.diag(found.uncertainty.covariance) > 0).all()
    assert found.uncertainty.sigma("cam1.k6") > 1


def test_a_released_board_takes_its_shape_and_the_covariance_stays_honest(rig, rng):
    """Boards drawn from the prior that the adjustment is told: all sets against chi-square (99.9 %)."""
    cameras = devices(rig)
    tolerances = Tolerances(print_mm=0.02, stretch_mm=0.01, bow_mm=0.11, dent_mm=0.06)
    total, degrees = 0.0, 0
    for _ in range(SETS):
        board = drawn_board(tolerances, rng)
        poses = random_poses(cameras, 10, rng)
        seen = observe(cameras, poses, rng, points=board)
        start = Estimate(cameras, poses, BOARD.points())
        found = adjust(seen, start, free_parameters(DEVICES, LENS), tolerances=tolerances, released=True)
        error, count = squared_error(found.calibration, cameras)
        total, degrees = total + error, degrees + count
    low, high = chi2.ppf([0.0005, 0.9995], degrees)
    assert low < total < high


def test_a_board_that_is_trusted_too_much_shows_in_the_covariance_if_its_tolerance_is_given(rig, rng):
    """Not released, but with the tolerance stated, errors are as large as predicted, and far larger than the noise says.

    Parameter by parameter: their combinations that the sightings fix to a part in ten thousand follow no linear rule. The misfit
    also counts as noise, so the prediction errs on the safe side.
    """
    cameras = devices(rig)
    tolerances = Tolerances(print_mm=0.02, bow_mm=0.11, dent_mm=0.06)
    told, untold = [], []
    for _ in range(SETS):
        board = drawn_board(tolerances, rng)
        poses = random_poses(cameras, 10, rng)
        seen = observe(cameras, poses, rng, points=board)
        start, free = Estimate(cameras, poses, BOARD.points()), free_parameters(DEVICES, LENS)
        told.append(normalised_errors(adjust(seen, start, free, tolerances=tolerances).calibration, cameras))
        untold.append(normalised_errors(adjust(seen, start, free).calibration, cameras))
    assert 0.3 < np.sqrt(np.mean(np.square(told))) < 1.4
    assert np.sqrt(np.mean(np.square(untold))) > 2 * np.sqrt(np.mean(np.square(told)))


@pytest.mark.parametrize("bend", ["cylinder", "saddle"])
def test_a_bow_of_the_stated_size_stays_within_the_covariance(rig, rng, bend):
    """Smooth bows of 0.1 mm RMS, the cylinder being the worst there is, with the tolerance stated."""
    cameras = devices(rig)
    points = BOARD.points()
    x, y = ((points - points.mean(axis=0)) / (np.ptp(points, axis=0) / 2 + 1e-9)).T[:2]
    bow = y**2 - np.mean(y**2) if bend == "cylinder" else x**2 - y**2
    bent = points + np.column_stack([0 * x, 0 * x, 0.1 * bow / bow.std()])
    for _ in range(2):
        poses = random_poses(cameras, 12, rng)
        seen = observe(cameras, poses, rng, points=bent)
        start, free = Estimate(cameras, poses, points), free_parameters(DEVICES, LENS)
        found = adjust(seen, start, free, tolerances=Tolerances(bow_mm=0.055, dent_mm=0.032)).calibration
        assert np.abs(normalised_errors(found, cameras)).max() < 4


@pytest.mark.parametrize("model", ["rational", "tilted"])
def test_a_lens_that_points_leave_open_has_neither_pole_nor_fold(rig, rng, model):
    """Eight poses whose points all lie within 250 px: coefficients are held by those of usual lenses, errors by their sigma."""
    camera = rig.cam1.optics.camera()
    poses = random_poses(devices(rig), 8, rng)
    seen = observe({"cam1": camera}, poses, rng)
    near = np.linalg.norm(seen.pixels - camera.matrix[:2, 2], axis=-1) < 250
    few = replace(seen, pixels=np.where(near[..., None], seen.pixels, np.nan))
    few, start = few.of_poses(range(len(poses))), Estimate({"cam1": camera}, poses, BOARD.points())
    found = adjust(few, start, free_parameters(["cam1"], {"cam1": MODELS[model]})).calibration
    assert is_one_to_one(found.cameras["cam1"])
    most = largest(found.cameras["cam1"], MATRIX + MODELS[model])
    assert (found.uncertainty.covariance.diagonal() ** 0.5 <= 1.001 * most).all()
    assert (np.abs(normalised_errors(found, {"cam1": camera})) < 5).all()


def test_a_camera_upside_down_is_doubted(rig, rng):
    """Images of camera 2 turned by 180 degrees calibrate as well as upright ones."""
    upright = {name: devices(rig)[name] for name in ("cam1", "cam2")}
    poses = random_poses(devices(rig), 12, rng)
    for roll, doubted in ((0, False), (95, False), (180, True)):
        rolled = rigid.from_rotation_vector([0, 0, np.deg2rad(roll)], np.zeros(3)) @ upright["cam2"].camera_from_world
        cameras = upright | {"cam2": replace(upright["cam2"], camera_from_world=rolled)}
        seen = observe(cameras, poses, rng)
        free = free_parameters(["cam1", "cam2"], dict.fromkeys(cameras, MODELS["brown"]))
        found = adjust(seen, Estimate(cameras, poses, BOARD.points()), free)
        assert any("cam2: stands upside down" in line for line in optical_checks.warnings(seen, found)) == doubted


def test_where_the_sightings_ask_for_a_fold_the_lens_is_not_forced(rig, rng):
    """A lens that does fold, in the corners, is found as it is; no other fits its points."""
    folded = rig.cam1.optics.model_copy(update={"distortion": (-2.9, 0.0, 0.0, 0.0, 0.0)}).camera()
    assert not is_one_to_one(folded, margin=0)
    poses = random_poses({**devices(rig), "cam1": folded}, 12, rng)
    seen = observe({"cam1": folded}, poses, rng)
    start = Estimate({"cam1": folded}, poses, BOARD.points())
    found = adjust(seen, start, free_parameters(["cam1"], {"cam1": MODELS["brown"]}))
    assert found.noise["cam1"] < 1.1 and found.calibration.cameras["cam1"].distortion[0] == pytest.approx(-2.9, rel=0.02)
    assert any("folds within the image" in warning for warning in optical_checks.warnings(seen, found))
