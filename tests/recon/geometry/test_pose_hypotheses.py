"""One view's centres allow poses that show them, the true one among them, and that tell where to look in another view."""

import numpy as np
import pytest

from recon.geometry import pose_hypotheses, rigid
from recon.model import circle_layout
from recon.tracking.rims import reach_px
from recon.tracking.tracker import FOLLOWED
from tests.recon.tracking import drawings

COUNT = 60


@pytest.fixture(scope="module")
def cameras(rig):
    return rig.cam1.optics.camera(), rig.cam2.optics.camera()


def test_every_pose_shows_the_centres_and_one_is_true(cameras, rig, rng):
    model = circle_layout.circle_centres(rig.target)
    for _ in range(COUNT):
        true = drawings.facing(rng, 50.0)
        seen = cameras[0].project(rigid.apply(true, model))
        found = pose_hypotheses.poses(cameras[0], seen, model)
        assert 1 <= len(found) <= 4
        for each in found:
            assert np.abs(cameras[0].project(rigid.apply(each, model)) - seen).max() < 1e-4
            assert each[:3, 2] @ (each[:3, 3] - cameras[0].centre) < 0
            assert np.abs(each[:3, :3] @ each[:3, :3].T - np.eye(3)).max() < 1e-9
        assert min(np.abs(each - true).max() for each in found) < 1e-3


def test_the_other_view_is_told_within_the_reach_of_a_fit(cameras, rig, rng):
    """From the middles of ellipses, which are not the projected centres, with 0.1 px of noise: far more than rims have."""
    model = circle_layout.circle_centres(rig.target)
    for _ in range(COUNT):
        first, second = (drawings.shown(camera, place, rig.target) for place in [drawings.facing(rng)] for camera in cameras)
        found = pose_hypotheses.poses(cameras[0], first.centre + 0.1 * rng.standard_normal((3, 2)), model)
        away = [np.linalg.norm(cameras[1].project(rigid.apply(each, model)) - second.centre, axis=1).max() for each in found]
        assert min(away) < reach_px(second, FOLLOWED).min()


def test_nonsense_allows_none(cameras, rig):
    model = circle_layout.circle_centres(rig.target)
    for centres in (np.full((3, 2), 500.0), np.full((3, 2), np.nan)):
        assert not pose_hypotheses.poses(cameras[0], centres, model)
