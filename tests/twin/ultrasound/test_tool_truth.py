"""Where truth puts a tool, the image shows it; delays, refraction and a fan included."""

from dataclasses import replace

import numpy as np
import pytest

from scenes.acoustics import TISSUES
from tests.twin.ultrasound.phantoms import down
from tests.twin.ultrasound.test_tool_echoes import POSE, RADIUS, SOFT, rod
from twin.ultrasound.bscan import scan
from twin.ultrasound.echo_solids import Body
from twin.ultrasound.tool_echoes import Tool
from twin.ultrasound.tool_truth import placed
from twin.ultrasound.transducer import Transducer

FAN = {"image_size": (300, 300), "scale_mm_per_px": (0.2, 0.15), "curved": {"radius_mm": 40, "sector_deg": 60, "lines": 256}}


@pytest.mark.parametrize("fan", [False, True])
@pytest.mark.parametrize("medium", [SOFT, TISSUES["water"]])
def test_a_ball_shines_where_truth_puts_its_tip(clean, fan, medium):
    """Of a stylus that is led from below, the tip is the nearest point; in water all is shown 3.5 % too deep."""
    array = Transducer.model_validate(clean.model_dump() | (FAN if fan else {}))
    body, pose = Body(medium, (), ()), down(array, (3.0, -4.0, 640.0), 8.0)
    place = np.array([array.face_mm[0] + 5.0, array.face_mm[1] + 24.0, 0.0])
    shaft = replace(rod(array, 90, ball=0.8), tip=place, along=np.array([0.0, -1.0, 0.0]), up=np.array([1.0, 0.0, 0.0]))
    found = scan(body, array, pose, 1, tools=(Tool(shaft.moved(pose)),))
    truth = placed(shaft.moved(pose), array, found.paths, pose)
    v, u = np.mean(np.nonzero(found.image == found.image.max()), axis=1)  # all that is white
    assert truth["tip_mm"] == pytest.approx(place)
    assert (u, v) == pytest.approx(truth["tip_px"], abs=2.5 if fan else 1.5)


def test_the_axis_is_cut_to_the_image_and_to_its_plane(clean):
    width, sx, sy = clean.width_mm, *clean.scale_mm_per_px
    paths = scan(Body(SOFT, (), ()), clean, POSE, 1).paths
    inside = placed(rod(clean, 30, (5.0, 20.0, 1.0)), clean, paths, POSE)
    tip = np.array([width / 2 + 5.0, 20.0])
    assert inside["tip_px"] == pytest.approx(tip / [sx, sy], abs=0.01) and inside["tip_mm"][2] == 1.0
    assert inside["axis_px"][1] == pytest.approx(tip / [sx, sy], abs=0.01)
    assert inside["axis_px"][0] == pytest.approx([0, (20.0 - tip[0] * np.tan(np.radians(30))) / sy], abs=0.01)
    assert inside["axis_beside_mm"] == pytest.approx([1, 1]) and np.isnan(inside["crossing_px"]).all()
    across = placed(rod(clean, 45, (2.0, 25.0, 4.0), 90), clean, paths, POSE)
    assert across["crossing_px"] == pytest.approx(np.array([width / 2 + 2.0, 21.0]) / [sx, sy], abs=0.01)
    away = placed(rod(clean, 45, (60.0, 25.0, 4.0), 90), clean, paths, POSE)
    assert np.isnan(away["axis_px"]).all() and away["tip_px"][0] > clean.image_size[0]


def test_a_shaft_shines_along_its_axis(clean):
    """Its front is a radius nearer than the axis."""
    shaft = rod(clean, 5, (10.0, 22.0, 0.0))
    found = scan(Body(SOFT, (), ()), clean, POSE, 1, tools=(Tool(shaft),))
    (u0, v0), (u1, v1) = placed(shaft, clean, found.paths, POSE)["axis_px"]
    for u in (40, 100, 180):
        row = v0 + (u - u0) / (u1 - u0) * (v1 - v0)
        assert found.envelope[:, u].argmax() == pytest.approx(row - RADIUS / clean.scale_mm_per_px[1], abs=1.1)
