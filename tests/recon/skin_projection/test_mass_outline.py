"""Is the outline of a mass where the lines that touch it come through the skin, by closed forms?"""

import numpy as np
import pytest
import trimesh

from recon.errors import InputError
from recon.geometry import rigid
from recon.skin_projection.lines_of_sight import Sight
from recon.skin_projection.mass_outline import normal_over, on_skin, outline, outlines
from tests.recon.skin_projection.skin_shapes import BALL, BALL_MM, DOME_MM, PLANE_MM, ball, dome, plane

EXACT_MM = 0.03  # half a cell, where the border runs along a row of them; facets of the ball are within 0.003 mm


@pytest.mark.parametrize("tilt", [(0.0, 0.0, 0.0), (0.2, -0.1, 0.0)])
def test_along_the_normal_a_ball_is_a_circle_of_its_radius(tilt):
    """On a flat skin, its middle the ball's foot on it."""
    skin = plane(tilt=tilt)
    normal = rigid.from_rotation_vector(tilt, [0, 0, 0])[:3, :3] @ [0, 0, -1.0]
    curve = outlines({"ball": ball()}, skin)["ball"]
    foot = BALL - normal * ((BALL - [0, 0, PLANE_MM]) @ normal)
    assert np.abs(np.linalg.norm(curve.points - foot, axis=1) - BALL_MM).max() < EXACT_MM
    assert np.abs((curve.points - [0, 0, PLANE_MM]) @ normal).max() < 1e-6
    assert (curve.points[0] == curve.points[-1]).all() and curve.on_skin == 1


def test_from_an_eye_a_ball_is_the_circle_of_its_tangent_cone():
    """Straight over the ball: half angle asin(r / distance), and the skin lies nearer to the eye than the ball."""
    eye = BALL - [0, 0, 300.0]
    curve = outlines({"ball": ball()}, plane(), eye)["ball"]
    radius = (PLANE_MM - eye[2]) * np.tan(np.arcsin(BALL_MM / 300))
    assert np.abs(np.linalg.norm((curve.points - BALL)[:, :2], axis=1) - radius).max() < EXACT_MM


def test_a_slanting_view_shifts_the_outline():
    eye = BALL + np.array([200.0, 0, -250])
    curve = outlines({"ball": ball()}, plane(), eye)["ball"]
    shift = (curve.points.min(axis=0) + curve.points.max(axis=0))[0] / 2 - BALL[0]
    assert shift == pytest.approx((BALL[2] - PLANE_MM) * 200 / 250, abs=0.5), (
        "towards the eye; a cone cut at a slant is no circle"
    )


def test_an_outline_has_the_lobes_of_its_mass():
    """Two balls that overlap: the outline has a waist, and no piece of either within it."""
    apart = np.array([12.0, 0, 0])
    both = trimesh.util.concatenate([ball(), ball(middle=BALL + apart)])
    chain = outline(both, Sight.along([0, 0, 1.0], BALL))
    places = Sight.along([0, 0, 1.0], BALL).chart(np.array([BALL, BALL + apart]))[:, :2]
    nearest = np.linalg.norm(chain[:, None] - places, axis=2).min(axis=1)
    assert np.abs(nearest - BALL_MM).max() < 0.15, "smoothing rounds the waist's corners"
    assert np.quantile(np.abs(nearest - BALL_MM), 0.9) < EXACT_MM


def test_the_normal_is_that_of_a_patch(rng):
    """A nipple of 3 mm over the mass turns the normal by no degree; one point's would be off by 40."""
    skin = dome()
    bump = np.exp(-((skin.vertices - [3.0, 0, PLANE_MM])[:, :2] ** 2).sum(axis=1) / (2 * 2.5**2))
    bumpy = trimesh.Trimesh(skin.vertices - np.outer(3 * bump, [0, 0, 1.0]), skin.faces, process=False)
    middle = np.array([0.0, 0, PLANE_MM + 25])
    normal = normal_over(ball(middle=middle).vertices, bumpy)
    assert np.rad2deg(np.arccos(-normal[2])) < 1.5
    assert normal_over(ball(middle=middle).vertices, skin) @ [0, 0, -1] > 1 - 1e-4


def test_turned_faces_turn_nothing():
    skin = plane()
    turned = trimesh.Trimesh(skin.vertices, skin.faces[:, ::-1], process=False)
    first, second = (outlines({"ball": ball()}, one)["ball"] for one in (skin, turned))
    assert np.allclose(first.points, second.points) and np.allclose(first.normals, second.normals)
    assert np.allclose(first.normals, [0, 0, -1])


def test_a_mass_beside_the_skin_is_refused():
    beside = ball(middle=BALL + np.array([200.0, 0, 0]))
    with pytest.raises(InputError, match="mass7: expected skin over it, found none"):
        on_skin("mass7", beside, plane(), Sight.along([0, 0, 1.0], BALL))


def test_a_body_that_is_flat_on_edge_is_refused():
    flat = trimesh.Trimesh([[0, 0, 690], [1, 0, 690], [0, 0, 700.0]], [[0, 1, 2]], process=False)
    with pytest.raises(InputError, match="expected closed bodies"):
        outline(flat, Sight.along([0, 0, 1.0], BALL))


def test_a_dome_bends_the_outline_up_to_it():
    """Each point lies on the dome, and on the cylinder of the ball along the normal."""
    middle = np.array([0.0, 0, PLANE_MM + 30])
    skin, body = dome(step=0.5), ball(middle=middle)
    curve, normal = outlines({"ball": body}, skin)["ball"], normal_over(body.vertices, skin)
    centre = np.array([0.0, 0, PLANE_MM + DOME_MM])
    assert np.abs(np.linalg.norm(curve.points - centre, axis=1) - DOME_MM).max() < 0.005, "facets of 0.5 mm sag by 0.001"
    assert np.abs(np.linalg.norm(np.cross(curve.points - middle, normal), axis=1) - BALL_MM).max() < EXACT_MM
