"""The fast picture of a skin that moves against the slow one of the skin moved, and against widths and places known."""

import numpy as np
import pytest
import trimesh

from recon.geometry import rigid
from recon.skin_projection import projector_image, skin_curve
from recon.skin_projection.lines_of_sight import Sight
from recon.skin_projection.live_picture import LivePicture, Strips, seen_from_skin
from recon.skin_projection.projector_image import Line, Lines
from recon.skin_projection.skin_curve import SkinCurve
from tests.recon.skin_projection import skin_shapes

MOVED = rigid.from_rotation_vector([0.06, -0.04, 0.1], [4.0, -30.0, 60.0])


def ring(skin, radius=18.0):
    """A closed curve on a skin about the line of sight."""
    turn = np.linspace(0, 2 * np.pi, 200)
    chain = skin_curve.evenly(radius * np.column_stack([np.cos(turn), np.sin(turn)]))
    return skin_curve.laid("ring", "cut", chain, Sight.along([0, 0, 1], [0, 0, 600]), skin)


def moved(curve):
    return SkinCurve(curve.name, curve.kind, rigid.apply(MOVED, curve.points), rigid.rotate(MOVED, curve.normals))


@pytest.mark.parametrize(("line", "gamma"), [(Line(1.0), 1.0), (Line(2.5, 0.6, (4.0, 2.0)), 2.2), (Line(0.5), 1.0)])
def test_it_is_the_picture_of_the_skin_and_curves_moved(line, gamma):
    """Light differs at borders of strips alone: the slow picture's are up to an eighth of a pixel wider."""
    skin, projector = skin_shapes.dome(), skin_shapes.projector()
    curve = ring(skin)
    found = LivePicture(skin, projector, gamma).draw(Strips.of(curve, line), MOVED)
    slow = projector_image.draw([moved(curve)], skin.copy().apply_transform(MOVED), projector, gamma, Lines(cut=line)).image
    fast, slow = ((image / 255.0) ** gamma for image in (found, slow))
    assert slow.sum() > 300
    assert fast.sum() == pytest.approx(slow.sum(), rel=0.12)
    assert np.abs(fast - slow).sum() < 0.15 * slow.sum()
    rows, columns = np.indices(slow.shape)
    for axis in (rows, columns):  # no shift
        assert (fast * axis).sum() / fast.sum() == pytest.approx((slow * axis).sum() / slow.sum(), abs=0.2)


def test_a_straight_line_on_a_plane_is_as_wide_as_it_should_be():
    """Light of a strip is width times length times pixels a square mm: 40 mm long, of a plane that faces the projector."""
    skin = skin_shapes.plane(size=(80.0, 60.0))
    projector = skin_shapes.projector()
    facing = skin_curve.laid("line", "cut", skin_curve.evenly([[-20.0, 0], [20, 0]]), Sight.along([0, 0, 1], [0, 0, 600]), skin)
    corners = np.array([[-20.0, -1, 670], [20, -1, 670], [20, 1, 670], [-20, 1, 670]])
    u, v = projector.project(corners).T
    area = abs(np.dot(u, np.roll(v, 1)) - np.dot(v, np.roll(u, 1))) / 2
    light = LivePicture(skin, projector).draw(Strips.of(facing, Line(2.0)), np.eye(4)).sum() / 255
    assert light == pytest.approx(area, rel=0.01)


@pytest.mark.parametrize("shift", [0.0, 0.13, 0.37])
def test_its_middle_is_where_it_should_be(shift):
    """Parts of a pixel along: light's middle across a line that is level in the projector's image, to hundredths of a pixel."""
    projector = skin_shapes.projector()
    rays = projector.rays([[600.0, 400 + shift], [602.0, 400 + shift], [603.0, 400 + shift]])
    points = projector.centre + 650 * rays
    curve = SkinCurve("level", "stroke", points, -rays)
    image = LivePicture(skin_shapes.plane(), projector).draw(Strips.of(curve, Line(1.4)), np.eye(4))[:, 601] / 255.0
    assert (image * np.arange(len(image))).sum() / image.sum() == pytest.approx(400 + shift, abs=0.01)


def test_what_the_skin_hides_is_dark():
    """A wall of skin between the projector and half of a line; with the patient turned away, all of it."""
    plane, projector = skin_shapes.plane(), skin_shapes.projector()
    line = skin_curve.laid("line", "cut", skin_curve.evenly([[-40.0, 0], [40, 0]]), Sight.along([0, 0, 1], [0, 0, 600]), plane)
    wall = trimesh.creation.box((1.0, 60.0, 40.0), rigid.transform(np.eye(3), [0.0, 0, skin_shapes.PLANE_MM - 20]))
    both = trimesh.util.concatenate([plane, wall.subdivide_to_size(2.0)])
    image = LivePicture(both, projector).draw(Strips.of(line, Line(1.0)), np.eye(4))

    def lit(x):
        u, v = np.rint(projector.project([x, 0.0, skin_shapes.PLANE_MM])).astype(int)
        return image[v, u] > 128

    top = np.array([0.5, 0, skin_shapes.PLANE_MM - 40])
    ray = top - projector.centre
    edge = projector.centre + ray * (skin_shapes.PLANE_MM - projector.centre[2]) / ray[2]  # of the wall's shadow
    assert 2 < edge[0] < 30
    assert [lit(x) for x in (-20, edge[0] - 1.5, edge[0] + 1.5, 35)] == [True, False, True, True]


def test_nothing_is_drawn_through_the_air():
    """A curve that goes over the skin's border and on behind it has a piece that is no curve on the skin."""
    points = np.array([[0.0, 0, 670], [0.5, 0, 670], [30, 0, 700], [30.5, 0, 700]])
    curve = SkinCurve("jump", "stroke", points, np.tile([0.0, 0, -1], (4, 1)))
    assert (Strips.of(curve, Line(1.0)).light > 0).tolist() == [True, False, True, False]


def test_nothing_to_draw_is_dark():
    assert not LivePicture(skin_shapes.plane(), skin_shapes.projector()).draw(Strips.joined([]), np.eye(4)).any()


def test_a_device_stands_to_the_skin_as_it_does_in_the_world():
    device, point = skin_shapes.projector(), np.array([3.0, 4, 660])
    in_skin = seen_from_skin(device, MOVED).project(point)
    np.testing.assert_allclose(in_skin, device.project(rigid.apply(MOVED, point)), atol=1e-8)
