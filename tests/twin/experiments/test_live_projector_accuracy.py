"""Whether the rows of patterns on a display measure the display."""

import numpy as np
import pytest

from recon.model.patterns import CentreLine, Fringes, Patterns
from tests.twin.experiments.asked import missed
from twin.experiments import live_projector_accuracy, virtual_screen
from twin.experiments.experiment_setup import Setup

SMALL = Patterns(projector_size=(96, 64), unwrap="centre_line", parts=(CentreLine(), Fringes(pitch=12, steps=3)))

pytestmark = pytest.mark.skipif(virtual_screen.installed() is None, reason="no Xvfb; `apt-get install xvfb` brings it")


def test_a_display_that_shows_each_pattern_meets_its_bar(rig):
    found = live_projector_accuracy.display(Setup(rig, {"small": SMALL}))
    assert (found["exact"], found["taken"]) == (1, 1)


def test_a_pixel_that_differs_misses_it(rig, monkeypatch):
    shot = virtual_screen.screenshot

    def one_off(display):
        return shot(display) ^ np.uint8(np.arange(96) == 7)[:, None]

    monkeypatch.setattr(virtual_screen, "screenshot", one_off)
    found = live_projector_accuracy.display(Setup(rig, {"small": SMALL}))
    assert len(missed(live_projector_accuracy.display, found)) == 2
