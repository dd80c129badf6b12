"""Looks of tracked bodies: closed, behind their print, with a tip or a foot where the description puts it."""

import numpy as np
import pytest
from pydantic import ValidationError

from recon.model import circle_layout
from scenes.handheld import body_look
from scenes.handheld.body_look import Look, Stand, any_stand
from scenes.handheld.looks import needle
from scenes.handheld.target_board import Board, covers
from tests.scenes.handheld.closed_parts import check_closed
from tests.twin.tracking.takes import rig_of_three

RIG = rig_of_three()
EYES = np.array([[-90.0, 0, 650], [90.0, 0, 650]])


@pytest.mark.parametrize("kind", ["board", "needle", "stylus"])
def test_all_but_the_print_is_closed_and_behind_it(kind):
    """The print is the first part, exactly in z = 0; of the rest nothing stands before a circle."""
    target = RIG.bodies["needle"]
    for seed in range(3):
        rng = np.random.default_rng(seed)
        front, *others = Look.named(kind)().parts(rng, target, any_stand(rng))
        assert front.slot == "target" and (front.mesh.vertices[:, 2] == 0).all()
        check_closed([front, *others], "target")
        assert all(part.slot != "target" for part in others)
        middle, half = circle_layout.middle(target)[:2], np.array(target.board_mm) / 2
        board = Board(tuple(middle - half), tuple(middle + half), 0.0)
        points = np.concatenate([part.mesh.vertices for part in others])
        assert not covers(np.column_stack([points, np.zeros(len(points))])[points[:, 2] > 0.01], board, 0.0)


def test_the_needle_ends_at_its_tip():
    """Along its direction, as far as it is long; the shaft is as thick as its gauge."""
    target, look = RIG.bodies["needle"], needle.Kind(gauge=18, length_mm=90, direction=(0.3, -0.6, -0.7))
    parts = look.parts(np.random.default_rng(1), target, any_stand(np.random.default_rng(2)))
    start, along = look.axis(target)
    tip = look.tip_mm(target)
    assert along == pytest.approx(np.array([0.3, -0.6, -0.7]) / np.linalg.norm([0.3, -0.6, -0.7]))
    steel = [part.mesh.vertices for part in parts if part.slot == "metal"]
    farthest = max(steel, key=lambda points: float((points @ along).max()))
    end = farthest[np.argmax(farthest @ along)]
    assert end == pytest.approx(tip, abs=0.1)
    away = np.linalg.norm(np.cross(farthest - start, along), axis=1)
    assert 2 * away.max() == pytest.approx(1.27, abs=0.01)
    reach = (farthest - tip) @ along
    assert reach.min() == pytest.approx(-93, abs=0.5), "3 mm of it stick in the handle"


def test_the_board_stands_on_what_is_below():
    """The foot's lowest points lie in the plane that the stand describes, wherever the board leans."""
    target = RIG.bodies["patient"]
    up = np.array([0.2, -0.3, 0.9]) / np.linalg.norm([0.2, -0.3, 0.9])
    stand = Stand(EYES, up, 140.0, np.array([1.0, 0, 0]))
    parts = Look.named("board")().parts(np.random.default_rng(3), target, stand)
    heights = np.concatenate([part.mesh.vertices for part in parts]) - circle_layout.middle(target)
    assert (heights @ up).min() == pytest.approx(-140, abs=0.5)


@pytest.mark.parametrize("fields", [{"kind": "needle", "gauge": 18}, {"kind": "stylus"}, {"kind": "stylus", "ball_mm": 0}])
def test_sound_meets_the_shaft_that_is_seen(fields):
    """As thick, with the same tip and direction; a needle's point lies on its wall, where its bevel is closed."""
    target, look = RIG.bodies["needle"], Look.model_validate(fields)
    shaft, (rear, tip) = look.shaft(target), look.line_mm(target)
    np.testing.assert_allclose(shaft.tip, tip)
    np.testing.assert_allclose(shaft.along, (tip - rear) / np.linalg.norm(tip - rear))
    assert shaft.up @ shaft.along == pytest.approx(0, abs=1e-12) and shaft.up[2] > 0
    assert np.linalg.norm(shaft.ends[1] - tip) == pytest.approx(shaft.radius if shaft.kind == "bevel" else 0)
    parts = look.parts(np.random.default_rng(1), target, any_stand(np.random.default_rng(2)))
    steel = np.concatenate([part.mesh.vertices for part in parts if part.slot == "metal"])
    steel = steel[(steel - tip) @ shaft.along < -10]
    away = np.linalg.norm(np.cross(steel - tip, shaft.along), axis=1)
    assert away.max() == pytest.approx(shaft.radius, abs=0.03)
    assert Look.named("board")().shaft(target) is None


def test_a_tube_is_as_its_gauge():
    """Wall and bore of ISO 9626's 18 gauge; a stylet fills it, and air is known."""
    target = RIG.bodies["needle"]
    tube, rod = (needle.Kind(gauge=18, filling=filling).shaft(target) for filling in ("air", "stylet"))
    assert (2 * tube.radius, 2 * tube.bore, rod.bore) == (1.27, 0.84, 0.0) and tube.filling.speed == pytest.approx(343, abs=3)
    for gauge, outer in needle.DIAMETERS_MM.items():
        assert 0.1 < (outer - needle.BORES_MM[gauge]) / 2 < 0.28


def test_a_body_looks_like_its_name():
    assert body_look.look_of("needle").kind == "needle" and body_look.look_of("stylus").kind == "stylus"
    assert body_look.look_of("patient").kind == body_look.look_of("thing").kind == "board"


def test_nonsense_is_refused_by_name():
    with pytest.raises(ValidationError, match=r"ball_mm: expected 0, or diameter_mm = 2 to 20, found 1"):
        Look.model_validate({"kind": "stylus", "ball_mm": 1})
    with pytest.raises(ValidationError, match=r"point_deg: expected a point of at most length_mm = 10, found one of 45.7 mm"):
        Look.model_validate({"kind": "stylus", "ball_mm": 0, "diameter_mm": 8, "point_deg": 5, "length_mm": 10})
    with pytest.raises(ValidationError, match=r"bevel_deg: expected a bevel of at most length_mm = 10, found one of 15.0 mm"):
        Look.model_validate({"kind": "needle", "gauge": 14, "bevel_deg": 8, "length_mm": 10})
    for field, value, words in (("gauge", 24, "expected one of"), ("direction", (0, 0, 1), "behind the board's face")):
        with pytest.raises(ValidationError, match=words) as caught:
            Look.model_validate({"kind": "needle", field: value})
        assert caught.value.errors()[0]["loc"][-1] == field
