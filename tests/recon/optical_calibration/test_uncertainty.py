"""Predicted uncertainty of points and projections is the scatter of what calibrations drawn from their covariance give."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import linearise
from recon.model.calibration import Calibration, Uncertainty
from recon.optical_calibration import uncertainty

DRAWS = 500
SIGMA = {"f": 0.6, "c": 0.5, "k": 4e-3, "p": 1e-4, "r": 5e-5, "t": 0.04}  # px, px, 1, 1, rad, mm; as of a good calibration
DEPTHS = (606.0, 660.0, 713.0)


@pytest.fixture
def optics(rig) -> Calibration:
    """The rig with a covariance whose parameters are all correlated, within and between devices."""
    cameras = {name: getattr(rig, name).optics.camera() for name in ("cam1", "cam2", "projector")}
    own = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    names = [f"{device}.{name}" for device in cameras for name in own]
    names += [f"{device}.{name}" for device in ("cam2", "projector") for name in ("rx", "ry", "rz", "tx", "ty", "tz")]
    sigma = np.array([SIGMA[name.split(".")[1][0]] for name in names])
    mixed = np.random.default_rng(5).normal(size=(len(names), len(names) + 5))
    correlation = mixed @ mixed.T
    correlation /= np.sqrt(np.outer(np.diag(correlation), np.diag(correlation)))
    return Calibration(cameras, Uncertainty(tuple(names), correlation * np.outer(sigma, sigma)))


@pytest.fixture
def drawn(optics, rng) -> list[Calibration]:
    changes = rng.multivariate_normal(np.zeros(len(optics.uncertainty.names)), optics.uncertainty.covariance, DRAWS)
    return [uncertainty.apply(optics, change) for change in changes]


@pytest.fixture
def volume(optics) -> np.ndarray:
    return uncertainty.working_volume(optics, DEPTHS)


def meet(first: Camera, second: Camera, pixels: list[np.ndarray], start: np.ndarray) -> np.ndarray:
    """Points : (m, 3) of least reprojection error in both images, by Gauss-Newton from a start nearby."""
    points = start.copy()
    for _ in range(4):
        seen = [linearise(camera, points, ()) for camera in (first, second)]
        slopes = np.concatenate([part.by_point for part in seen], axis=1)
        missing = np.concatenate([found - part.pixels for found, part in zip(pixels, seen, strict=True)], axis=1)
        points += np.linalg.solve(np.swapaxes(slopes, 1, 2) @ slopes, np.einsum("mki,mk->mi", slopes, missing)[..., None])[..., 0]
    return points


def onto(fixed: np.ndarray, moving: np.ndarray) -> tuple[Rotation, np.ndarray, np.ndarray]:
    """The rigid motion that brings points onto others: rotation about the middle of `moving`, both middles."""
    middle, wanted = moving.mean(axis=0), fixed.mean(axis=0)
    return Rotation.align_vectors(fixed - wanted, moving - middle)[0], middle, wanted


def assert_same(samples: np.ndarray, predicted: np.ndarray) -> None:
    """Samples : (draws, m, k) about zero scatter by predicted : (m, k, k), as far as so many draws can tell.

    In units of the prediction their covariance is the identity, give or take 1 / sqrt(draws) an entry and 1.4 times that on the
    diagonal; the mean over points, which are correlated, has at most that error too.
    """
    whiten = np.linalg.inv(np.linalg.cholesky(predicted))
    z = np.einsum("mij,nmj->nmi", whiten, samples)
    found = np.einsum("nmi,nmj->mij", z, z) / len(samples)
    assert np.abs(found - np.eye(samples.shape[-1])).max() < 5 * np.sqrt(2 / len(samples))
    assert np.abs(found.mean(axis=0) - np.eye(samples.shape[-1])).max() < 3 * np.sqrt(2 / len(samples))


def test_applying_follows_the_definition(optics):
    """A turn is about the device's axes, from the left; a shift is one of `device_from_world`; the rest is added."""
    names = optics.uncertainty.names
    change = np.zeros(len(names))
    for name, value in {"cam2.ry": 0.1, "cam2.tz": 3.0, "projector.cx": -2.0, "cam1.k2": 0.5}.items():
        change[names.index(name)] = value
    found = uncertainty.apply(optics, change).cameras
    before, after = optics.cameras["cam2"].camera_from_world, found["cam2"].camera_from_world
    assert np.allclose(after[:3, :3] @ before[:3, :3].T, Rotation.from_rotvec([0, 0.1, 0]).as_matrix())
    assert np.allclose(after[:3, 3] - before[:3, 3], [0, 0, 3])
    assert found["projector"].matrix[0, 2] == optics.cameras["projector"].matrix[0, 2] - 2
    assert found["cam1"].distortion[1] == optics.cameras["cam1"].distortion[1] + 0.5


def overlaid(optics, drawn, volume, pair):
    """Each drawn cloud with the best rigid motion that lays it over the true one."""
    pixels = [optics.cameras[name].project(volume) for name in pair]
    for sample in drawn:
        cloud = meet(*(sample.cameras[name] for name in pair), pixels, volume)
        yield cloud, *onto(volume, cloud)


@pytest.mark.parametrize("pair", [("cam1", "projector"), ("cam2", "projector"), ("cam1", "cam2")])
def test_points_scatter_as_predicted(optics, drawn, volume, pair):
    points = volume[::7]
    pixels = [optics.cameras[name].project(points) for name in pair]
    found = np.array([meet(*(sample.cameras[name] for name in pair), pixels, points) for sample in drawn])
    assert_same(found - points, uncertainty.triangulation(optics, *pair, points))


def test_shapes_scatter_as_predicted(optics, drawn, volume):
    """Each drawn cloud is laid over the true one by the best rigid motion first."""
    pair = ("cam1", "projector")
    left = [turn.apply(cloud - middle) + wanted - volume for cloud, turn, middle, wanted in overlaid(optics, drawn, volume, pair)]
    predicted = uncertainty.shape(optics, *pair, volume[::7], volume)
    assert_same(np.array(left)[:, ::7], predicted)
    absolute = uncertainty.triangulation(optics, *pair, volume[::7])
    assert np.trace(predicted, axis1=1, axis2=2).mean() < 0.5 * np.trace(absolute, axis1=1, axis2=2).mean()


def test_lengths_scatter_as_predicted(optics, drawn, volume):
    pair = ("cam1", "projector")
    ratios = []
    for cloud, turn, middle, wanted in overlaid(optics, drawn, volume, pair):
        ratios.append(((cloud - middle) * turn.inv().apply(volume - wanted)).sum() / ((volume - wanted) ** 2).sum())
    assert np.std(ratios) == pytest.approx(uncertainty.scale(optics, *pair, volume), rel=4 / np.sqrt(2 * DRAWS))


def test_projections_scatter_as_predicted(optics, drawn, volume):
    """For each draw the rigid motion of the scene is found that changes all devices' images least."""
    volume = volume[::3]
    true = {name: camera.project(volume) for name, camera in optics.cameras.items()}
    left = []
    for sample in drawn:
        scene = volume.copy()
        for _ in range(2):
            shifts, turns = np.tile(np.eye(3), (len(scene), 1, 1)), np.cross(np.eye(3), scene[:, None])  # a row a mode
            modes = np.swapaxes(np.concatenate([shifts, turns], axis=1), 1, 2)
            seen = {name: linearise(camera, scene, ()) for name, camera in sample.cameras.items()}
            slopes = np.concatenate([(part.by_point @ modes).reshape(-1, 6) for part in seen.values()])
            missing = np.concatenate([(true[name] - part.pixels).ravel() for name, part in seen.items()])
            motion = np.linalg.solve(slopes.T @ slopes, slopes.T @ missing)
            scene = Rotation.from_rotvec(motion[3:]).apply(scene) + motion[:3]
        left.append({name: camera.project(scene) - true[name] for name, camera in sample.cameras.items()})
    for name in optics.cameras:
        predicted = uncertainty.projection(optics, name, volume, volume)
        assert_same(np.array([draw[name] for draw in left]), predicted)


def test_a_common_motion_of_devices_is_no_uncertainty_of_shape(optics, volume):
    """All that is uncertain is where camera 2 and the projector stand, together: what they measure moves, and keeps its form."""
    names = tuple(f"{device}.{name}" for device in ("cam2", "projector") for name in ("rx", "ry", "rz", "tx", "ty", "tz"))
    slopes = np.zeros((len(names), 6))
    for k, device in enumerate(("cam2", "projector")):
        rotation = optics.cameras[device].camera_from_world[:3, :3]
        # the world turns by w and shifts by s: R' = R exp(w), t' = t + R s; as a turn from the left that is exp(R w) R
        slopes[6 * k : 6 * k + 3, 3:] = rotation
        slopes[6 * k + 3 : 6 * k + 6, :3] = rotation
    moved = replace(optics, uncertainty=Uncertainty(names, slopes @ np.diag([0.1**2] * 3 + [1e-4**2] * 3) @ slopes.T))
    absolute = uncertainty.triangulation(moved, "cam2", "projector", volume)
    assert np.sqrt(np.trace(absolute, axis1=1, axis2=2)).min() > 0.1
    left = uncertainty.shape(moved, "cam2", "projector", volume, volume)
    assert np.sqrt(np.abs(np.trace(left, axis1=1, axis2=2))).max() < 1e-6
    assert uncertainty.scale(moved, "cam2", "projector", volume) < 1e-9


def test_scale_follows_the_baseline(optics, volume):
    """A baseline uncertain by one part in a thousand, and nothing else, makes all lengths so."""
    names = ("projector.tx", "projector.ty", "projector.tz")
    translation = optics.cameras["projector"].camera_from_world[:3, 3]
    known = replace(optics, uncertainty=Uncertainty(names, 1e-6 * np.outer(translation, translation)))
    assert uncertainty.scale(known, "cam1", "projector", volume) == pytest.approx(1e-3, rel=1e-6)
    left = uncertainty.shape(known, "cam1", "projector", volume, volume)
    sigma = np.sqrt(np.trace(left, axis1=1, axis2=2))
    assert sigma == pytest.approx(1e-3 * np.linalg.norm(volume - volume.mean(axis=0), axis=1), rel=1e-6)


def test_the_working_volume_is_seen_by_all(optics, volume):
    assert set(np.round(volume[:, 2], 6)) == set(DEPTHS)
    for camera in optics.cameras.values():
        pixels = camera.project(volume)
        assert (pixels > -0.5).all() and (pixels < np.array(camera.size) - 0.5).all()
    with pytest.raises(ValueError, match="depths: expected some at which the devices' views overlap"):
        uncertainty.working_volume(optics, (20.0,))


def test_a_calibration_without_covariance_has_none_to_propagate(optics, volume):
    with pytest.raises(ValueError, match="found one without"):
        uncertainty.triangulation(Calibration(optics.cameras), "cam1", "cam2", volume)
