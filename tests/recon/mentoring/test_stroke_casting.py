"""A stroke lies where camera 1's rays meet the skin: on planes and spheres by closed forms, wherever the skin was."""

import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry import rigid
from recon.mentoring import stroke_casting
from recon.mentoring.posts import Stroke, Text
from recon.mentoring.stroke_casting import cast
from recon.skin_projection.live_picture import seen_from_skin
from tests.recon.mentoring import desk
from tests.recon.skin_projection import skin_shapes

MOVED = rigid.from_rotation_vector([0.01, -0.008, 0.1], [6.0, -4.0, 12.0])


def stroke(*places, **others):
    return Stroke(kind="stroke", picture=1, places=list(places), **others)


def test_on_a_tilted_plane_it_is_where_rays_meet_it():
    tilt = np.array([0.3, -0.2, 0.0])
    skin, camera = skin_shapes.plane(tilt=tilt), desk.camera()
    places = [(250.0, 200.0), (400.0, 310.5), (330.0, 180.0)]
    curve = cast("it", stroke(*places), camera, skin)
    normal = rigid.from_rotation_vector(tilt, [0, 0, 0])[:3, 2]
    rays = camera.rays(places)
    corners = rays * (normal[2] * skin_shapes.PLANE_MM / (rays @ normal))[:, None]
    np.testing.assert_allclose((curve.points - [0, 0, skin_shapes.PLANE_MM]) @ normal, 0, atol=1e-6)
    away = np.linalg.norm(curve.points[:, None] - corners, axis=2).min(axis=0)
    assert away.max() < stroke_casting.STEP_MM / 2 + 1e-6
    np.testing.assert_allclose(curve.points[[0, -1]], corners[[0, -1]], atol=1e-6)
    assert curve.on_skin == 1 and (curve.normals @ curve.points[0] < 0).all(), "towards the camera"


def test_on_a_sphere_it_lies_on_the_sphere():
    """As near as the mesh of 1 mm does: sag 1 / (4 * 60) mm; first hits, on the side of the camera."""
    camera = desk.camera()
    curve = cast("it", stroke((260.0, 256.0), (380.0, 250.0)), camera, skin_shapes.dome())
    middle = [0, 0, skin_shapes.PLANE_MM + skin_shapes.DOME_MM]
    assert np.abs(np.linalg.norm(curve.points - middle, axis=1) - skin_shapes.DOME_MM).max() < 0.01
    assert (curve.points[:, 2] < skin_shapes.PLANE_MM + 30).all()
    pixels = camera.project(curve.points)
    along = (pixels - [260, 256]) @ np.array([120, -6]) / np.hypot(120, 6)
    off = (pixels - [260, 256]) @ np.array([6, 120]) / np.hypot(120, 6)
    assert (np.diff(along) > 0).all()
    assert np.abs(off).max() < 0.5, "straight in space, and so bent a little by the lens"


def test_it_is_fixed_to_the_skin_of_its_picture():
    """Drawn on a picture of the skin moved, it is in that skin's own frame: back in the world it is under the same pixels."""
    camera, places = desk.camera(), [(300.0, 240.0), (360.0, 260.0)]
    curve = cast("it", stroke(*places), seen_from_skin(camera, MOVED), skin_shapes.dome())
    np.testing.assert_allclose(camera.project(rigid.apply(MOVED, curve.points))[[0, -1]], places, atol=1e-6)
    still = cast("it", stroke(*places), camera, skin_shapes.dome())
    assert np.linalg.norm(curve.points[0] - still.points[0]) > 3


def test_a_tap_is_a_dot():
    curve = cast("it", stroke((320.0, 256.0)), desk.camera(), skin_shapes.plane())
    assert 0.2 < curve.length_mm < 1


def test_dashes_and_widths():
    assert stroke_casting.look(stroke((1, 1), width_mm=2.0)).width_mm == 2
    assert stroke_casting.look(stroke((1, 1), dashed=True)).dash_mm == stroke_casting.DASH_MM
    assert stroke_casting.look(stroke((1, 1))).dash_mm is None


def test_a_text_stands_upright_and_as_high_as_it_should():
    """Capitals without curves; its lower left corner's height is the click's, level as camera 1 sees it."""
    camera = desk.camera()
    text = Text(kind="text", picture=1, at=(260.0, 250.0), text="HIT", height_mm=8.0)
    curve = cast("it", text, camera, skin_shapes.plane())
    known = np.isfinite(curve.points).all(axis=1)
    assert not known.all(), "letters are apart"
    low, high = np.nanmin(curve.points, axis=0), np.nanmax(curve.points, axis=0)
    assert high[1] - low[1] == pytest.approx(8.0, abs=0.1)
    at = camera.rays([260.0, 250.0])
    at = at * skin_shapes.PLANE_MM / at[2]
    assert low[0] == pytest.approx(at[0], abs=0.1) and (low[1] + high[1]) / 2 == pytest.approx(at[1], abs=0.1)


@pytest.mark.parametrize(("drawn", "complaint"), [
    (stroke((5.0, 5.0), (5.0, 20.0)), "expected the drawing on the skin, found none of it there"),
    (stroke((-3.0, 250.0), (300.0, 250.0)), "expected places in the picture of 640x512 px"),
    (stroke(*[(250.0 + 150 * (k % 2), 220.0 + k / 30) for k in range(1999)]), "up to 10 m of lines, found 1"),
    (Text(kind="text", picture=1, at=(2.0, 2.0), text="here"), "found none of it there"),
])  # fmt: skip
def test_what_cant_be_drawn_is_said(drawn, complaint):
    with pytest.raises(InputError, match=complaint):
        cast("it", drawn, desk.camera(), skin_shapes.plane())


def test_a_stroke_over_the_skins_border_is_drawn_where_there_is_skin():
    curve = cast("it", stroke((320.0, 256.0), (639.0, 256.0)), desk.camera(), skin_shapes.plane())
    assert 0.2 < curve.on_skin < 0.6
    pieces = stroke_casting.seen(curve, desk.camera())
    assert len(pieces) == 1 and np.abs(pieces[0][0] - [320, 256]).max() < 1e-6
