"""Agreement of the poses: 1 by noise alone, and what makes it more is in the covariance."""

from dataclasses import replace

import numpy as np
import pytest

from recon.geometry.board_shape import departures
from recon.model.calibration import Calibration
from recon.optical_calibration import joint_calibration
from recon.optical_calibration.joint_calibration import Settings, calibrate, deviation
from recon.optical_calibration.pose_consistency import Consistency
from tests.recon.board_sets import BOARD, devices, random_poses, sightings

QUICK = Settings(distortion="decentred")


@pytest.fixture(scope="module")
def cameras(rig):
    return devices(rig)


def results(cameras, seeds, monkeypatch, of_pose):
    """Consistencies, and squared errors of the parameters over their expectation, of sets whose poses differ by `of_pose`."""
    found, squares = [], []
    judge = joint_calibration.consistency
    monkeypatch.setattr(joint_calibration, "consistency", lambda *given: found.append(judge(*given)) or found[-1])
    sizes = {name: camera.size for name, camera in cameras.items()}
    for seed in seeds:
        rng = np.random.default_rng(seed)
        poses = random_poses(cameras, 14, rng)
        parts = []
        for k, pose in enumerate(poses):
            devices_then, points = of_pose(k, rng)
            (one,) = sightings(devices_then, pose[None], rng, points=points)
            parts.append(replace(one, name=f"{k:02d}"))
        calibration = calibrate(parts, BOARD, sizes, QUICK).adjustment.calibration
        error, covariance = deviation(calibration, Calibration(cameras)), calibration.uncertainty.covariance
        scale = np.sqrt(np.diag(covariance))
        squares.append(error / scale @ np.linalg.solve(covariance / np.outer(scale, scale), error / scale) / len(error))
    return found, float(np.mean(squares))


def test_steady_poses_scatter_as_their_noise(cameras, monkeypatch):
    """Of 3 sets: 1, to three standard errors of some 40 parameters in 14 poses each; without a warning."""
    found, squared = results(cameras, range(3), monkeypatch, lambda k, rng: (cameras, BOARD.points()))
    assert np.mean([one.scatter for one in found]) == pytest.approx(1, abs=0.2)
    assert not any(one.warning for one in found) and 0.7 < squared < 1.4
    assert all(1 <= one.rise < 1.05 for one in found)


@pytest.mark.parametrize("sets", [1, pytest.param(6, marks=pytest.mark.slow)])
def test_a_board_that_bends_is_told_and_counts(cameras, monkeypatch, sets):
    """Arches and twists of 0.02 mm (RMS), new in each pose: found to a factor of two, and errors as large as predicted."""
    ways = departures(BOARD.points())[0][:, -3:]

    def bent(k, rng):
        return cameras, BOARD.points() + (ways @ (0.02 * rng.standard_normal(3))).reshape(-1, 3)

    found, squared = results(cameras, range(sets), monkeypatch, bent)
    assert all(one.scatter > 2 and "bend" in one.warning and one.rise > 1.5 for one in found)
    assert all((one.covariance == one.covariance.T).all() for one in found), "as readers demand it"
    assert 0.01 < np.median([one.bend_mm for one in found]) < 0.04
    assert sets == 1 or 0.4 < squared < 2  # 84 random bends in 6 sets, in directions that are far from alike


@pytest.mark.parametrize("moved", [lambda k: k >= 7, lambda k: k % 2], ids=["at half time", "every other pose"])
def test_a_device_that_is_touched_is_told(cameras, monkeypatch, moved):
    """Camera 2's principal point, by 0.1 px."""
    matrix = cameras["cam2"].matrix.copy()
    matrix[0, 2] += 0.1
    touched = {**cameras, "cam2": replace(cameras["cam2"], matrix=matrix)}
    found, _ = results(cameras, range(1), monkeypatch, lambda k, rng: (touched if moved(k) else cameras, BOARD.points()))
    assert all(one.warning and one.rise > 1.3 for one in found)


@pytest.mark.parametrize("sets", [1, pytest.param(6, marks=pytest.mark.slow)])
def test_projector_coordinates_that_shift_from_pose_to_pose_are_told_and_count(cameras, monkeypatch, sets):
    """By 0.05 px along each axis, as grey fringes do whose shifts err: found to a factor of two, and errors as predicted."""

    def shifted(k, rng):
        matrix = cameras["projector"].matrix.copy()
        matrix[:2, 2] += 0.05 * rng.standard_normal(2)
        return {**cameras, "projector": replace(cameras["projector"], matrix=matrix)}, BOARD.points()

    found, squared = results(cameras, range(sets), monkeypatch, shifted)
    assert all("coordinates shift" in one.warning and "bend" not in one.warning and one.rise > 1.3 for one in found)
    assert all(0.025 < one.shift_px < 0.1 for one in found)
    assert sets == 1 or 0.5 < squared < 1.8


def test_what_hardly_raises_the_uncertainty_is_not_warned_of():
    """Residuals of 0.006 px that contradict each other twofold, and a bend of 0.3 um, beside a lens known far less."""
    slight = Consistency(5.06, 0.00032, 2.5, 0.0, 0.0, 2.15, 1.001, np.eye(1))
    assert slight.warning is None
    large = replace(slight, rise=1.7).warning
    assert "bend by 0.00032 mm" in large and "2.1 times the residuals" in large and "1.7 times as large" in large
    assert "bend" not in replace(slight, rise=1.7, bend_sigma=1.0).warning, "as likely without one"
