"""A circle that is covered is looked for, and found, where the other two of its view ask for it."""

import numpy as np
import pytest

from recon.ellipses import Ellipses
from recon.tracking import covered, pose
from recon.tracking.outline_model import ellipses_of
from recon.tracking.tracker import Tracker
from tests.recon.tracking import drawings


@pytest.fixture(scope="module")
def cameras(rig):
    return rig.cam1.optics.camera(), rig.cam2.optics.camera()


def shown(camera, place, target):
    return Ellipses(*ellipses_of(camera, place, pose.circle_centres(target), target.outer_diameter_mm / 2))


def hidden(image, ellipse, rng):
    """With a finger of 45 DN over the right half of an ellipse, its white middle too."""
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    radius = np.sqrt(np.linalg.det(ellipse.shape[0]))
    finger = (u > ellipse.centre[0, 0] - 0.1 * radius) & (
        np.hypot(u - ellipse.centre[0, 0], v - ellipse.centre[0, 1]) < 1.8 * radius
    )
    image = image.copy()
    image[finger] = np.clip(45 + 2 * rng.standard_normal(finger.sum()), 0, 255).astype(np.uint8)
    return image


@pytest.mark.parametrize("which", [0, 1, 2])
def test_the_third_place_follows_from_two_discs(cameras, rig, rng, which):
    """As far as a view is affine: perspective across the target is the rest."""
    away = []
    for _ in range(40):
        true = shown(cameras[0], drawings.facing(rng), rig.target)
        told = covered.third(true, which, rig.target)
        away.append(np.linalg.norm(told.centre[0] - true.centre[which]))
        assert np.abs(told.shape[0] - true.shape[which]).max() < 0.15 * np.trace(true.shape[which])
    assert np.median(away) < 6 and max(away) < 20


def test_two_discs_under_wrong_names_tell_no_third(cameras, rig, rng):
    """c0 and c2 are 40 mm apart, c0 and c1 25."""
    true = shown(cameras[0], drawings.facing(rng), rig.target)
    exchanged = true[np.array([0, 2, 1])]
    assert np.isnan(covered.third(exchanged, 1, rig.target).centre).all()


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_target_with_a_disc_half_covered_is_found_in_both_views(cameras, rig, rng, which):
    place = drawings.facing(rng, 25.0)
    frames = [drawings.frame(camera, [place], rig.target, 80.0, rng) for camera in cameras]
    frames = [
        hidden(frame, shown(camera, place, rig.target)[[which]], rng) for frame, camera in zip(frames, cameras, strict=True)
    ]
    tracker = Tracker(cameras, rig.target)
    tracker.remember(place, 0.0)
    found = tracker.step(*frames, time_s=0.02)
    assert found.found, found.pose.reason
    assert all(view.outlines.seen[which] < 0.7 for view in found.views)
    assert np.linalg.norm((found.pose.world_from_target @ [10, 15, 0, 1] - place @ [10, 15, 0, 1])[:3]) < 0.15
    error = found.pose.world_from_target[:3, 3] - place[:3, 3]
    assert error @ np.linalg.solve(found.pose.covariance[3:, 3:], error) < 40
