"""The published recipe: what its steps do to logits, masks and centres, and by how much its matrix is no rotation."""

import cv2
import numpy as np
import pytest

from recon.geometry import rigid
from recon.model import circle_layout
from tests.recon.tracking import flat_faces
from twin.experiments.baselines import published
from twin.optics.surface_session import calibration_of

SMALL, FULL = (320, 240), (1280, 1024)
PLACES = np.array([[101.0, 90.0], [140.0, 97.0], [92.0, 30.0]])  # c0, c1, c2 as seen from the front


@pytest.fixture(scope="module")
def cameras(rig):
    known = calibration_of(rig).cameras
    return known["cam1"], known["cam2"]


def logits(places, names, heights=None):
    """What a sure detector would answer: a peak at each of the places and a name for its cell."""
    detection, identity = np.zeros((65, 30, 40), np.float32), np.zeros((4, 30, 40), np.float32)
    detection[64], identity[3] = 12, 5
    for k, ((u, v), name) in enumerate(zip(places.astype(int), names, strict=True)):
        detection[8 * (v % 8) + u % 8, v // 8, u // 8] = 14 if heights is None else heights[k]
        identity[name, v // 8, u // 8] += 20
    return detection, identity


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1], [1, 2, 0]])
def test_peaks_are_named_wherever_they_come(order):
    assert np.array_equal(published.candidates(*logits(PLACES[order], order)), PLACES)


def test_a_fourth_peak_that_is_weaker_is_left_out(rng):
    places = np.vstack([PLACES, [[300.0, 200.0]]])
    assert np.array_equal(published.candidates(*logits(places, [0, 1, 2, 0], [14, 14, 14, 10])), PLACES)


def test_of_two_peaks_next_to_each_other_the_higher_one_counts():
    moved = np.array([[3, 2], [0, 0], [0, 0]])
    places = np.vstack([PLACES, PLACES[:1] + moved[:1]])
    assert np.array_equal(published.candidates(*logits(places, [0, 1, 2, 3], [13, 14, 14, 15])), PLACES + moved)


def test_one_missing_name_is_told_by_the_others():
    assert np.array_equal(published.candidates(*logits(PLACES, [0, 3, 2])), PLACES)


def test_exchanged_names_are_mended_only_for_the_first_two():
    """Of the three ways to exchange two names the shoelace mends one; the others give a target that is turned."""
    assert np.array_equal(published.candidates(*logits(PLACES, [1, 0, 2])), PLACES)
    for names in ([2, 1, 0], [0, 2, 1]):
        assert not np.array_equal(published.candidates(*logits(PLACES, names)), PLACES)


def test_fewer_than_three_are_none():
    assert published.candidates(*logits(PLACES[:2], [0, 1])) is None


def test_a_patch_has_the_peak_in_its_middle():
    assert np.array_equal(
        published.patch_origins(PLACES, SMALL, FULL), [[404 - 59, 384 - 59], [560 - 59, 414 - 59], [368 - 59, 128 - 59]]
    )


def test_centres_of_masks_are_good_to_a_tenth_of_a_pixel(rng):
    """A pixelated outline of some 250 px tells its centre to about a twentieth; crumbs beside it do not matter."""
    v, u = np.mgrid[:120, :120]
    errors = []
    for _ in range(40):
        centre, axes, angle = rng.uniform(55, 65, 2), rng.uniform(25, 46, 2), rng.uniform(0, np.pi)
        x, y = u - centre[0], v - centre[1]
        a, b = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        mask = (a / axes[0]) ** 2 + (b / axes[1]) ** 2 <= 1
        mask[2:9, 2:9] = True
        origin = rng.integers(-30, 1200, 2)
        errors.append(published.centre_from_mask(mask, origin) - origin - centre)
    assert np.sqrt(np.mean(np.square(errors))) < 0.1
    assert np.isnan(published.centre_from_mask(np.zeros((120, 120), bool), np.zeros(2, int))).all()


def test_logits_above_zero_are_the_mask():
    disc = np.float32(cv2.circle(np.full((120, 120), -3, np.int16), (60, 58), 40, 2, -1))
    centres = published.centres_from_logits(np.stack([disc] * 3), np.array([[0, 0], [10, 20], [-5, 3]]))
    assert np.allclose(centres, [[60, 58], [70, 78], [55, 61]], atol=0.05)


def test_points_that_are_seen_without_error_give_the_pose(cameras, rig, rng):
    model = circle_layout.circle_centres(rig.target)
    for _ in range(10):
        true = flat_faces.facing(rng.uniform(-40, 40, 2), rng.uniform(-180, 180), rng.uniform([-50, -50, 600], [50, 50, 710]))
        seen = [camera.project(rigid.apply(true, model)) for camera in cameras]
        found = published.pose_from_centres(*seen, *cameras)
        assert np.abs(found - true).max() < 1e-3  # mm; what OpenCV's five steps of undistortion leave


def test_the_matrix_is_as_little_a_rotation_as_its_points_are_off(rng):
    """x·y is, to first order, the errors across the axes over their lengths: (e1 - e0)·y / 25 and (e2 - e0)·x / 40."""
    model = np.array([[0.0, 0, 0], [25, 0, 0], [0, 40, 0]])
    sigma, skew, expected = 0.2, [], np.sqrt(2 / 25**2 + 2 / 40**2)
    for _ in range(400):
        true = flat_faces.facing(rng.uniform(-40, 40, 2), rng.uniform(-180, 180))
        error = sigma * rng.standard_normal((3, 3))
        found = published.pose_from_points(rigid.apply(true, model) + error)
        x, y, z = found[:3, :3].T
        predicted = (error[1] - error[0]) @ true[:3, 1] / 25 + (error[2] - error[0]) @ true[:3, 0] / 40
        assert abs(x @ y - predicted) < 10 * (sigma / 25) ** 2 * 3
        assert np.isclose(z @ z, 1 - (x @ y) ** 2) and np.isclose(np.linalg.det(found[:3, :3]), z @ z)
        assert np.allclose([x @ z, y @ z], 0) and np.allclose([x @ x, y @ y], 1)
        skew.append(x @ y)
    assert abs(np.std(skew) / (sigma * expected) - 1) < 4 / np.sqrt(2 * 400)


def test_wrong_distances_along_the_axes_are_not_noticed():
    """A target half as large again gives the same rotation: nothing in the recipe says how large it is."""
    true = flat_faces.facing((20, -10), 30)
    points = rigid.apply(true, np.array([[0.0, 0, 0], [25, 0, 0], [0, 40, 0]]) * 1.5)
    assert np.allclose(published.pose_from_points(points), true)
