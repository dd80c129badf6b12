"""Whether the rows of patterns on a display measure the display."""

import numpy as np
import pytest

from recon.model.patterns import CentreLine, Fringes, Patterns
from twin.experiments import live_projector_accuracy, virtual_screen

SMALL = Patterns(projector_size=(96, 64), unwrap="centre_line", parts=(CentreLine(), Fringes(pitch=12, steps=3)))

pytestmark = pytest.mark.skipif(virtual_screen.installed() is None, reason="no Xvfb; `apt-get install xvfb` brings it")


def test_a_display_that_shows_each_pattern_meets_its_bar():
    exact, taken, _ = live_projector_accuracy.display({"small": SMALL})
    assert (exact.measured, taken.measured) == (1, 1)


def test_a_pixel_that_differs_misses_it(monkeypatch):
    shot = virtual_screen.screenshot

    def one_off(display):
        return shot(display) ^ np.uint8(np.arange(96) == 7)[:, None]

    monkeypatch.setattr(virtual_screen, "screenshot", one_off)
    exact, taken, _ = live_projector_accuracy.display({"small": SMALL})
    assert not exact.ok
    assert not taken.ok
