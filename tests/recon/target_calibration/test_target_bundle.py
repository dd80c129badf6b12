"""The target measured from many pairs: exact, honest about its errors and the cameras', and not misled by a few wrong pairs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from recon.geometry import camera_jacobian, rigid
from recon.model import circle_layout
from recon.model.calibration import Uncertainty
from recon.target_calibration import target_bundle
from tests.recon.target_calibration import target_pairs

DRAWS, PAIRS = 14, 4
BUT_DIAMETER = [0, 1, 2, 4, 5, 6]  # of which the covariance has a bound


@pytest.fixture(scope="module")
def cameras(rig):
    return rig.cam1.optics.camera(), rig.cam2.optics.camera()


def numbers(target):
    """In the order of NAMES."""
    return np.array([*circle_layout.lengths(target), target.outer_diameter_mm, *target.curvature_per_m])


def squared_error(found, actual):
    """Of lengths and curvature, over their covariance."""
    off = (numbers(found.target) - numbers(actual))[BUT_DIAMETER]
    return off @ np.linalg.solve(found.covariance[np.ix_(BUT_DIAMETER, BUT_DIAMETER)], off)


def test_errors_are_as_large_as_predicted(cameras, rig, rng):
    """Squared errors over their covariance are chi-square: half or double of it would be seen; the diameter's is a bound."""
    squared = []
    for _ in range(DRAWS):
        actual = target_pairs.printed(rig.target, rng)
        found = target_bundle.adjust(target_pairs.many(cameras, actual, PAIRS, rng), rig.target, None)
        off = numbers(found.target) - numbers(actual)
        squared.append(squared_error(found, actual))
        assert np.abs(off[:3]).max() < 0.01 and abs(off[3]) < 4 * np.sqrt(found.covariance[3, 3])
    low, high = chi2.ppf([1e-4, 1 - 1e-4], DRAWS * len(BUT_DIAMETER))
    assert low < sum(squared) < high


def test_errors_of_the_cameras_are_in_the_covariance(cameras, rig, rng):
    """Baseline and angle of camera 2 drawn from their covariance: the target's scale is off by theirs, and that is predicted."""
    names, sigma = ("ry", "tx", "fx"), np.array([5e-5, 0.1, 0.3])
    optics, squared, blind = Uncertainty(tuple(f"cam2.{name}" for name in names), np.diag(sigma**2)), [], []
    for k in range(DRAWS):
        real = camera_jacobian.moved(cameras[1], names, sigma * rng.standard_normal(3))
        actual = target_pairs.printed(rig.target, rng)
        pairs = target_pairs.many(cameras, actual, PAIRS, rng, (cameras[0], real))
        squared.append(squared_error(target_bundle.adjust(pairs, rig.target, optics), actual))
        if k < 4:
            blind.append(squared_error(target_bundle.adjust(pairs, rig.target, None), actual))
    low, high = chi2.ppf([1e-4, 1 - 1e-4], DRAWS * len(BUT_DIAMETER))
    assert low < sum(squared) < high
    assert sum(blind) > chi2.ppf(1 - 1e-4, len(blind) * len(BUT_DIAMETER))


def test_a_wrong_pair_is_left_out(cameras, rig, rng):
    """Of one a circle is off by half a pixel."""
    actual = target_pairs.printed(rig.target, rng)
    pairs = target_pairs.many(cameras, actual, 15, rng)
    first, second = pairs[4].views
    off = np.array([[0, 0], [0.5, 0.3], [0, 0]])
    pairs[4] = replace(pairs[4], views=(first, replace(second, centres=second.centres + off)))
    found = target_bundle.adjust(pairs, rig.target, None)
    assert np.flatnonzero(~found.used).tolist() == [4]
    assert np.abs(numbers(found.target)[:3] - numbers(actual)[:3]).max() < 0.01


def test_noise_larger_than_predicted_is_measured(cameras, rig, rng):
    pairs = target_pairs.many(cameras, rig.target, 20, rng)
    less = [replace(p, views=tuple(replace(view, covariance=view.covariance / 9) for view in p.views)) for p in pairs]
    usual, found = (target_bundle.adjust(each, rig.target, None) for each in (pairs, less))
    assert found.noise.centres == pytest.approx(3 * usual.noise.centres, rel=0.15)
    np.testing.assert_allclose(found.covariance[:3, :3], usual.covariance[:3, :3], rtol=0.3)


def test_predicted_ellipses_of_a_bowed_board_are_those_of_tilted_circles(cameras, rig):
    """Each circle by itself, its plane turned by hand to the normal of the board there."""
    target = rig.target.model_copy(update={"curvature_per_m": (0.3, -0.1, 0.2)})
    pose = rigid.from_rotation_vector([2.9, 0.4, 0.1], [0.0, 20.0, 660.0])
    found = target_bundle.predicted(cameras, pose, numbers(target))
    circles = circle_layout.circles(target)
    for k, (centre, slope) in enumerate(zip(circles.centres, circles.slopes, strict=True)):
        normal = np.array([*-slope, 1.0]) / np.linalg.norm([*slope, 1.0])
        turn = Rotation.align_vectors(normal[None], [[0, 0, 1]])[0].as_matrix()
        rim = np.linspace(0, 2 * np.pi, 400, endpoint=False)
        points = centre + circles.radius_mm * np.column_stack([np.cos(rim), np.sin(rim), np.zeros_like(rim)]) @ turn.T
        outline = cameras[0].project(rigid.apply(pose, points))
        centred = outline - found[2 * k : 2 * k + 2]
        a, b, c = found[12 + 3 * k : 15 + 3 * k]
        away = np.linalg.norm(np.linalg.solve([[a, b], [b, c]], centred.T), axis=0)
        assert np.abs(away - 1).max() * a < 0.002
