"""Are outlines drawn on the skin where they are, through projector, skin and camera; and does the measurement see it if not?"""

import numpy as np
import pytest

from scenes.catalogue import build_scene
from twin.experiments import live_skin_accuracy as light
from twin.experiments.experiment_setup import Setup

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def true_skin():
    return next(thing.mesh for thing in build_scene(light.BREAST).things if not thing.inside)


def test_on_the_true_skin_light_lies_on_the_true_outlines(rig, true_skin, tmp_path):
    """What is left is the camera's noise and half a pixel of the projector, 0.2 mm. A picture is kept."""
    setup = Setup(rig, {}, out=tmp_path)
    errors = light.drawn(setup, light.BREAST, true_skin, light.tumours(light.BREAST), None, "test")
    assert np.median(errors.all) < 0.1 and np.quantile(errors.all, 0.95) < 0.2
    assert (tmp_path / "live_skin_test.png").is_file()


def test_a_projector_that_stands_elsewhere_is_noticed(rig, true_skin):
    """Calibrated 1 mm aside: the light falls about 1 mm beside the outlines where they run across that way."""
    pose = rig.projector.optics.device_from_world
    x, y, z = pose.translation_mm
    moved = pose.model_copy(update={"translation_mm": (x + 1.0, y, z)})
    optics = rig.projector.optics.model_copy(update={"device_from_world": moved})
    off = rig.model_copy(update={"projector": rig.projector.model_copy(update={"optics": optics})})
    picture = light.picture_of(off, true_skin, light.tumours(light.BREAST), None)
    errors = light.compared(Setup(rig, {}), light.BREAST, picture, "test")
    assert 0.3 < np.median(errors.all) < 1.0
