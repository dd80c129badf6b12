"""Is a stroke lit where it was drawn, by cameras of half the size on the true skin; and does the measurement see it if not?"""

import numpy as np
import pytest

from scenes.catalogue import build_scene
from tests.twin.small_rigs import half
from twin.experiments import live_mentor_accuracy as mentor
from twin.experiments.experiment_setup import Setup

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def setup(rig, tmp_path_factory):
    return Setup(half(rig), {}, out=tmp_path_factory.mktemp("mentor"))


@pytest.fixture(scope="module")
def true_skin():
    return next(thing.mesh for thing in build_scene(mentor.BREAST).things if not thing.inside)


def test_strokes_are_lit_where_they_were_drawn(setup, true_skin):
    """Of a patient who moved before; half a pixel of the projector is 0.2 mm."""
    errors = mentor.drawn(setup, true_skin, 0.0, "rest")
    assert np.median(errors.all) < 0.2 and np.quantile(errors.all, 0.95) < 0.8
    assert (setup.out / "live_mentor_rest.png").is_file()


def test_of_a_patient_who_moves_on_light_lags_by_its_way(setup, true_skin):
    """1.5 mm along x: seen where lines run across it, and hardly where they run along."""
    errors = mentor.drawn(setup, true_skin, 1.5, "moving")
    assert 1.2 < np.quantile(errors.all, 0.95) < 2.5
    assert np.median(errors.all) > 0.5, "a motion that nobody knows of is noticed"


def test_the_motion_between_scenes_is_that_of_their_settings():
    pose = mentor.pose_between(mentor.BREAST, mentor.shifted(0.0))
    np.testing.assert_allclose(np.degrees(np.arccos(pose[0, 0])), mentor.TURN_DEG, atol=1e-6)
    further = mentor.pose_between(mentor.shifted(0.0), mentor.shifted(1.5))
    np.testing.assert_allclose(further[:3, 3], [1.5, 0, 0], atol=1e-6)
