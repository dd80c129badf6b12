"""The target's pose from its circles: exact, with an honest covariance, and not found where it isn't the target."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from recon import rigid
from recon.circles import centre_offsets
from recon.tracking import pose
from recon.tracking.pose import Sighting
from twin.session import calibration_of

SIGMA_PX = 0.03
POSES = 60


@pytest.fixture(scope="module")
def cameras(rig):
    known = calibration_of(rig).cameras
    return known["cam1"], known["cam2"]


def random_pose(rng):
    """Up to 35 degrees off facing the cameras, turned anyhow, over the working volume."""
    turn = Rotation.from_euler("xyz", [*rng.uniform(-35, 35, 2), rng.uniform(-180, 180)], degrees=True).as_matrix()
    return rigid.transform(turn, rng.uniform([-60, -60, 600], [60, 60, 710]))


def seen(cameras, target, world_from_target, rng=None):
    """What both cameras show of the target: centres of ellipses, with noise if there is a generator."""
    model, radius = pose.circle_centres(target), target.outer_diameter_mm / 2
    views = []
    for camera in cameras:
        centres = camera.project(rigid.apply(world_from_target, model)) + centre_offsets(camera, world_from_target, model, radius)
        noise = 0 if rng is None else SIGMA_PX * rng.standard_normal((3, 2))
        views.append(Sighting(camera, centres + noise, np.tile(SIGMA_PX**2 * np.eye(2), (3, 1, 1))))
    return views


def error(found, true):
    """Turn (rad) and shift (mm) from the true pose to the one found : (6,)."""
    turn = Rotation.from_matrix(found[:3, :3] @ true[:3, :3].T).as_rotvec()
    return np.concatenate([turn, found[:3, 3] - true[:3, 3]])


def test_exact_where_there_is_no_noise(cameras, rig, rng):
    """Circles are followed to rounding, although their ellipses' centres are a quarter of a pixel off the projected ones."""
    for _ in range(10):
        true = random_pose(rng)
        found = pose.estimate(*seen(cameras, rig.target, true), rig.target)
        assert np.abs(error(found.world_from_target, true)).max() < 1e-6
        assert found.misfit < 1e-6


def test_the_covariance_is_that_of_the_errors(cameras, rig, rng):
    """Squared normalised errors of 60 poses and misfits follow chi-square: means within 4 standard errors."""
    squared, misfits = [], []
    for _ in range(POSES):
        true = random_pose(rng)
        found = pose.estimate(*seen(cameras, rig.target, true, rng), rig.target)
        off = error(found.world_from_target, true)
        squared.append(off @ np.linalg.solve(found.covariance, off))
        misfits.append(found.misfit)
    for values in (squared, misfits):
        assert abs(np.mean(values) - 6) < 4 * np.sqrt(12 / POSES)
    assert np.mean(np.array(squared) < chi2.ppf(0.95, 6)) > 0.85


def test_other_names_are_not_the_target(cameras, rig, rng):
    for order in ([1, 0, 2], [2, 1, 0], [0, 2, 1], [1, 2, 0], [2, 0, 1]):
        views = [replace(view, centres=view.centres[order]) for view in seen(cameras, rig.target, random_pose(rng), rng)]
        found = pose.estimate(*views, rig.target)
        assert not found.found and "mm apart" in found.reason and np.isnan(found.world_from_target).all()


def test_names_that_differ_between_the_views_are_not_the_target(cameras, rig, rng):
    for order in ([1, 0, 2], [2, 1, 0], [0, 2, 1]):
        first, second = seen(cameras, rig.target, random_pose(rng), rng)
        found = pose.estimate(first, replace(second, centres=second.centres[order]), rig.target)
        assert not found.found


def test_swapped_cameras_are_noticed(cameras, rig, rng):
    for _ in range(10):
        first, second = seen(cameras, rig.target, random_pose(rng), rng)
        swapped = (replace(first, centres=second.centres), replace(second, centres=first.centres))
        assert not pose.estimate(*swapped, rig.target).found


def test_a_centre_that_is_off_is_noticed(cameras, rig, rng):
    """By half a pixel, 17 times what it is known to be."""
    first, second = seen(cameras, rig.target, random_pose(rng), rng)
    first.centres[1] += [0.35, 0.35]
    found = pose.estimate(first, second, rig.target)
    assert not found.found and "misfit" in found.reason


def test_nonsense_is_not_found(cameras, rig):
    view = Sighting(cameras[0], np.full((3, 2), np.nan), np.tile(np.eye(2), (3, 1, 1)))
    assert not pose.estimate(view, replace(view, camera=cameras[1]), rig.target).found
    same = replace(view, centres=np.full((3, 2), 500.0))
    assert not pose.estimate(same, replace(same, camera=cameras[1]), rig.target).found
