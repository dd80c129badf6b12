"""Does the projector's image put a line of the right width where it belongs on the skin, and none where its light can't reach?"""

import numpy as np
import trimesh

from recon.geometry.camera import Camera
from recon.skin_projection import projector_image, skin_curve
from recon.skin_projection.lines_of_sight import Sight, first_hits
from recon.skin_projection.projector_image import Line, Lines, coverage, draw, visible
from recon.skin_projection.skin_curve import laid
from tests.recon.skin_projection.skin_shapes import PLANE_MM, STANDS_AT, dome, plane, projector

SIGHT = Sight.along([0, 0, 1.0], [0, 0, PLANE_MM])
GAMMA = 2.2


def straight(start, end, skin, kind="mass"):
    return laid("line", kind, skin_curve.evenly([start, end]), SIGHT, skin)


def lit_skin(drawing, skin, device):
    """Places on the skin of the pixels that are lit : (n, 3) mm, and their light : (n,)."""
    v, u = np.nonzero(drawing.image)
    sight = Sight.of_device(device)
    hits = first_hits(sight, device.undistort(np.column_stack([u, v]).astype(float)), skin)
    return hits.points, (drawing.image[v, u] / 255) ** GAMMA


def test_light_lies_on_the_curve_and_is_as_wide():
    """Weighted by light, the middle across the line is on it to some hundredths of a pixel of 0.36 mm, and its spread a box's."""
    skin, device, width = dome(), projector(), 2.0
    drawing = draw([straight([-25.0, 4.0], [25.0, 4.0], skin)], skin, device, GAMMA, Lines(mass=Line(width)))
    points, light = lit_skin(drawing, skin, device)
    within = np.abs(points[:, 0]) < 20
    across, weight = points[within, 1] - 4.0, light[within] / light[within].sum()
    assert abs(weight @ across) < 0.02
    pixel = 0.37
    assert abs(weight @ across**2 - (width**2 + pixel**2) / 12) < 0.02
    assert drawing.lit["line"].all()


def test_without_the_lens_the_line_would_be_elsewhere():
    """The projector's distortion counts: the image differs from a pinhole's by more than the line's width."""
    skin, device = plane(size=(200.0, 120.0)), projector()
    curve = straight([80.0, -40.0], [90.0, 40.0], skin)
    curved, straight_on = (
        draw([curve], skin, Camera(device.size, device.matrix, np.array([k1, 0, 0, 0, 0]), device.camera_from_world)).image > 0
        for k1 in (-2.0, 0.0)
    )
    assert curved.any() and (curved & straight_on).sum() < 0.1 * curved.sum()


def test_no_light_reaches_the_far_side_of_a_ridge():
    """A wall of 20 mm between projector and line shades as much as its light's slope says."""
    floor = plane()
    base, top = PLANE_MM, PLANE_MM - 20.0
    wall = trimesh.Trimesh(
        [[0, -50, base], [0, 50, base], [0, -50, top], [0, 50, top]], [[0, 1, 2], [1, 3, 2], [0, 2, 1], [1, 2, 3]], process=False
    )
    skin = trimesh.util.concatenate([floor, wall])
    x = np.linspace(-40, 40, 161)
    points = np.column_stack([x, np.zeros_like(x), np.full_like(x, PLANE_MM)])
    seen = visible(points, skin, projector())
    shade = 20.0 * -STANDS_AT[0] / (top - STANDS_AT[2])  # by similar triangles
    assert seen[x < -0.5].all() and seen[x > shade + 0.5].all() and not seen[(x > 0.5) & (x < shade - 0.5)].any()


def test_what_lies_outside_the_image_is_not_drawn():
    skin, device = plane(size=(600.0, 100.0), step=4.0), projector()
    drawing = draw([straight([-280.0, 0.0], [280.0, 0.0], skin)], skin, device)
    assert 0.5 < drawing.lit["line"].mean() < 0.95
    assert drawing.image[:, 0].any() and drawing.image[:, -1].any(), "up to the border on both sides"


def test_values_give_light_through_the_projectors_gamma():
    skin, device = plane(), projector()
    half = Lines(scan=Line(3.0, 0.5))
    image = draw([straight([-20.0, 0.0], [20.0, 0.0], skin, "scan")], skin, device, GAMMA, half).image
    assert image.max() == round(255 * 0.5 ** (1 / GAMMA))


def test_dark_pixels_stay_dark_and_nothing_is_drawn_of_nothing():
    skin, device = plane(), projector()
    curve = straight([-20.0, 0.0], [20.0, 0.0], skin)
    dark = np.zeros(device.size[::-1], bool)
    dark[:, :600] = True
    image = draw([curve], skin, device, dark=dark).image
    assert image.any() and not image[dark].any()
    assert not draw([], skin, device).image.any()


def test_coverage_is_the_area(rng):
    """Of quadrilaterals of any place: their sum is their area, to the fineness of the count, 1/64 px a pixel of the border."""
    for shift in rng.uniform(0, 1, (5, 2)):
        corners = np.array([[[10.0, 10], [30, 14], [28, 17], [9, 13]]]) + shift
        (a, b), (c, d) = corners[0, 2] - corners[0, 0], corners[0, 3] - corners[0, 1]
        area = abs(a * d - b * c) / 2
        assert abs(coverage(corners, (64, 48)).sum() / area - 1) < 0.1


def test_a_camera_is_expected_to_see_what_is_lit_alone():
    """Of a line that a shadow covers by half, from where the shadow ends on."""
    skin, device = plane(), projector()
    line = straight([-20.0, 0.0], [20.0, 0.0], skin)
    dark = np.zeros(device.size[::-1], bool)
    dark[:, : round(device.project(np.array([[0.0, 0.0, PLANE_MM]]))[0, 0])] = True
    drawing = draw([line], skin, device, dark=dark)
    camera = Camera(device.size, device.matrix, np.zeros(5), np.eye(4))
    seen = projector_image.expected_view([line], drawing.lit, skin, camera, Lines()) > 200
    ends = camera.project(np.array([[x, 0.0, PLANE_MM] for x in (0.0, 20.0)]))[:, 0]
    assert abs(np.flatnonzero(seen.any(axis=0))[0] - ends[0]) < 3 and abs(np.flatnonzero(seen.any(axis=0))[-1] - ends[1]) < 3
