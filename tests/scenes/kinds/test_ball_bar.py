"""The ball bar: its balls stand as far apart as it is long, however it is turned."""

import numpy as np
import pytest
from pydantic import ValidationError

from scenes.kinds import ball_bar


@pytest.mark.parametrize(("turn", "rise"), [(20.0, 0.0), (-130.0, 25.0), (90.0, -40.0)])
def test_balls_and_rod_lie_on_one_line(turn, rise):
    """The second ball is farther from camera 1 by the sine of the rise; the rod's ends are the balls' centres."""
    config = ball_bar.Config(turn_deg=turn, rise_deg=rise, background_mm=None)
    scene = ball_bar.build(config)
    first, second = (shape.centre for shape in scene.shapes)
    along = (second - first) / config.length_mm
    assert np.linalg.norm(along) == pytest.approx(1) and along[2] == pytest.approx(np.sin(np.deg2rad(rise)))
    rod = next(thing for thing in scene.things if thing.name == "rod").mesh.vertices
    places = (rod - first) @ along
    assert places.min() == pytest.approx(0, abs=1e-6) and places.max() == pytest.approx(config.length_mm)
    aside = np.linalg.norm(rod - first - np.outer(places, along), axis=1)
    assert aside.max() == pytest.approx(config.rod_mm / 2)


def test_a_background_through_a_ball_is_refused():
    with pytest.raises(ValidationError, match="background_mm: expected at least 700"):
        ball_bar.Config(rise_deg=30.0, background_mm=690.0)
