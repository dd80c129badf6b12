"""A tip beside balls, boxes, lines and planes, whose distances are known, and its covariances against sampling."""

import numpy as np
import pytest
import trimesh

from recon.errors import InputError
from recon.geometry import rigid
from recon.model.tip import Tip
from recon.navigation import tool_distances
from recon.navigation.tool_distances import IN_PLANE_MM, at_plane, from_path, from_surface, is_inside, surface_of, tip_at

POSE = rigid.from_rotation_vector([2.8, 0.3, -0.4], [30, -12, 655])
HALF = np.array([6.0, 9.0, 4.0])
NOISE = np.diag([0.04, 0.09, 0.01])  # mm2
SHAPE = (160, 120)
MM_PER_PX = 0.25
SAMPLES = 20000


def surface(mesh):
    return surface_of(np.asarray(mesh.vertices), np.asarray(mesh.faces))


@pytest.fixture(scope="module")
def box():
    """A box of `HALF` sides that is turned and moved."""
    return surface(trimesh.creation.box(2 * HALF, POSE))


def box_distance(points):
    """Signed distance of points in a box's own frame, in closed form."""
    beyond = np.abs(points) - HALF
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0)


def test_distances_from_a_box_are_exact_at_faces_edges_and_corners(box, rng):
    points = rng.uniform(-15, 15, (300, 3))
    found = [from_surface(point, NOISE, box).mm for point in rigid.apply(POSE, points)]
    assert (box_distance(points) < 0).sum() > 10
    np.testing.assert_allclose(found, box_distance(points), atol=1e-9)


def test_distances_from_a_ball(rng):
    ball = surface(trimesh.creation.icosphere(5, 8.0).apply_translation([12, -5, 690]))
    ways = rng.standard_normal((60, 3))
    radii = rng.uniform(0.5, 30, 60)
    points = [12, -5, 690] + radii[:, None] * ways / np.linalg.norm(ways, axis=1)[:, None]
    found = [from_surface(point, NOISE, ball).mm for point in points]
    np.testing.assert_allclose(found, radii - 8.0, atol=0.01)  # 20 480 triangles lie up to 0.005 mm within the ball


def test_triangles_that_are_left_out_are_never_the_nearest(rng):
    """Of triangles at random, large and small ones: as if the distance from each had been taken."""
    corners = rng.uniform(-20, 20, (400, 1, 3)) + rng.standard_normal((400, 3, 3)) * rng.exponential(3, (400, 1, 1))
    soup = surface_of(corners.reshape(-1, 3), np.arange(1200).reshape(-1, 3))
    for point in rng.uniform(-25, 25, (50, 3)):
        nearest = trimesh.triangles.closest_point(corners, np.tile(point, (400, 1)))
        expected = np.linalg.norm(nearest - point, axis=1).min()
        assert abs(from_surface(point, NOISE, soup).mm) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("wound", [1, -1])
def test_inside_is_inside_through_a_small_hole_and_either_winding(wound, rng):
    ball = trimesh.creation.icosphere(3, 8.0)
    points = rng.uniform(-9, 9, (200, 3))
    depths = 8.0 - np.linalg.norm(points, axis=1)
    holed = surface_of(ball.vertices, ball.faces[3:, ::wound])
    clear = np.abs(depths) > 1.0  # mm from the surface, which the hole is a part of
    found = np.array([is_inside(point, holed) for point in points])
    np.testing.assert_array_equal(found[clear], depths[clear] > 0)


def test_triangles_without_an_area_change_nothing(box):
    flat = np.array([[[0, 0, 600], [0, 0, 600], [0, 0, 600]], [[0, 0, 600], [1, 0, 600], [2, 0, 600]]], float)
    joined = np.concatenate([flat, box.triangles]).reshape(-1, 3)
    again = surface_of(joined, np.arange(len(joined)).reshape(-1, 3))
    assert len(again.triangles) == len(box.triangles)
    assert from_surface(POSE[:3, 3], NOISE, again).mm == pytest.approx(-HALF.min(), abs=1e-9)
    with pytest.raises(InputError, match="masses: expected triangles with an area, found 2 without"):
        surface_of(flat.reshape(-1, 3), np.arange(6).reshape(-1, 3))


def test_a_tip_on_the_surface_has_a_sigma_across_it(box):
    on = rigid.apply(POSE, [0, 0, HALF[2]])
    found = from_surface(on, NOISE, box)
    assert found.mm == pytest.approx(0, abs=1e-9)
    assert found.sigma_mm == pytest.approx(np.sqrt(POSE[:3, 2] @ NOISE @ POSE[:3, 2]), rel=1e-6)


def test_the_tips_covariance_is_that_of_sampled_poses_and_tips(rng):
    """At a lever arm of 150 mm; standard deviations of 20 000 samples are known to 0.5 %."""
    root = rng.standard_normal((6, 6)) * np.array([3e-4] * 3 + [0.02] * 3)[:, None]
    own = np.diag([0.01, 0.02, 0.03])
    tip_mm = np.array([10.0, -30.0, -145.0])
    _, covariance = tip_at(POSE, root @ root.T, tip_mm, own)
    poses = rigid.moved(np.broadcast_to(POSE, (SAMPLES, 4, 4)), rng.standard_normal((SAMPLES, 6)) @ root.T)
    tips = tip_mm + rng.standard_normal((SAMPLES, 3)) * np.sqrt(np.diag(own))
    seen = np.einsum("nij,nj->ni", poses[:, :3, :3], tips) + poses[:, :3, 3]
    root_of = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(root_of, (seen - rigid.apply(POSE, tip_mm)).T)
    np.testing.assert_allclose(np.cov(whitened), np.eye(3), atol=5 / np.sqrt(SAMPLES))


@pytest.mark.parametrize("place", [[0, 0, 12], [1, -2, 1], [14, 0, 9]])
def test_sigmas_of_distances_are_those_of_sampled_tips(box, rng, place):
    """Over a face, within, and over an edge."""
    tip = rigid.apply(POSE, place)
    small = NOISE * 0.01
    found = from_surface(tip, small, box)
    tips = rng.multivariate_normal(tip, small, 3000)
    sampled = np.std([from_surface(each, small, box).mm for each in tips])
    assert found.sigma_mm == pytest.approx(sampled, rel=0.08)  # five standard deviations of 3000 samples' own


def test_a_tip_beside_a_path():
    """A path along x: the tip 3 mm aside and 4 mm below, 12 mm before the aim; the shaft tilted by 5 degrees."""
    plan = np.array([[0.0, 0, 600], [40, 0, 600]])
    axis = np.array([np.cos(np.deg2rad(5)), np.sin(np.deg2rad(5)), 0])
    found = from_path(np.array([28.0, 3, 604]), NOISE, axis, plan)
    assert found.off_mm == pytest.approx(5) and found.left_mm == pytest.approx(12) and found.angle_deg == pytest.approx(5)
    aside = np.array([0, 0.6, 0.8])
    assert found.off_sigma_mm == pytest.approx(np.sqrt(aside @ NOISE @ aside))
    beyond = from_path(np.array([41.0, 0, 600]), NOISE, -axis, plan)
    assert beyond.left_mm == pytest.approx(-1) and beyond.angle_deg == pytest.approx(175)
    assert beyond.off_mm == 0 and beyond.off_sigma_mm == pytest.approx(np.sqrt((NOISE[1, 1] + NOISE[2, 2]) / 2))
    assert from_path(np.array([28.0, 3, 604]), NOISE, None, plan).angle_deg is None


WORLD_FROM_PIXEL = POSE @ np.diag([MM_PER_PX, MM_PER_PX, 1, 1])


def beside(image_mm, way, length_mm=100.0):
    """Figures of a tip and a direction that are given in the image's frame, mm."""
    axis = rigid.rotate(POSE, np.array(way) / np.linalg.norm(way))
    return at_plane(rigid.apply(POSE, image_mm), NOISE, axis, length_mm, WORLD_FROM_PIXEL, SHAPE)


def test_a_shaft_that_will_cross_the_image():
    """From 12 mm before the plane, at 45 degrees along the rows."""
    found = beside([5, 20, -12], [1, 0, 1])
    assert found.off_mm == pytest.approx(-12)
    assert found.sigma_mm == pytest.approx(np.sqrt(POSE[:3, 2] @ NOISE @ POSE[:3, 2]))
    np.testing.assert_allclose(found.crossing.pixel, [17 / MM_PER_PX, 20 / MM_PER_PX])
    assert found.crossing.ahead_mm == pytest.approx(12 * np.sqrt(2)) and found.crossing.in_image
    assert found.seen is None, "none of it lies in the slice yet"


def test_a_shaft_that_has_crossed_beside_the_image():
    found = beside([35, 20, 3], [1, 0, 1])
    assert found.crossing.ahead_mm == pytest.approx(-3 * np.sqrt(2)) and not found.crossing.in_image
    along = np.array([32 - IN_PLANE_MM, 32 + IN_PLANE_MM]) / MM_PER_PX  # as far aside as it is off the plane, at 45 degrees
    np.testing.assert_allclose(found.seen, np.column_stack([along, [80, 80]]))


@pytest.mark.parametrize(("off", "seen"), [(1.0, True), (2.0, False)])
def test_a_shaft_along_the_plane_does_not_cross_it(off, seen):
    found = beside([20, 10, off], [0, 1, 0], 8.0)
    assert found.crossing is None and (found.seen is not None) == seen
    if seen:
        np.testing.assert_allclose(found.seen, np.array([[20, 2], [20, 10]]) / MM_PER_PX)


def test_a_tip_without_an_axis_has_what_needs_none(box):
    tip = Tip(np.array([0.0, 0, -100]), np.eye(3) * 0.01)
    plan, scan = np.array([[0.0, 0, 600], [0, 0, 650]]), (WORLD_FROM_PIXEL, SHAPE)
    found = tool_distances.figures(POSE, np.zeros((6, 6)), tip, {"box": box}, plan, scan)
    assert found.axis is None and found.path.angle_deg is None and found.plane.crossing is None and found.plane.seen is None
    assert found.masses["box"].mm == pytest.approx(100 - HALF[2], abs=1e-9)
    assert found.plane.off_mm == pytest.approx(-100, abs=1e-9) and found.sigma_mm == pytest.approx(np.sqrt(0.03))


def test_without_masses_plan_and_image_there_is_the_tip():
    tip = Tip(np.array([0.0, 0, -100]), np.eye(6) * 0.01, np.array([0.0, 0, -1]))
    found = tool_distances.figures(POSE, np.zeros((6, 6)), tip, {})
    np.testing.assert_allclose(found.tip, rigid.apply(POSE, [0, 0, -100]))
    np.testing.assert_allclose(found.axis, -POSE[:3, 2])
    assert found.path is None and found.plane is None and not found.masses
