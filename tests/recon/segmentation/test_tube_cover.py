"""The body about a tube: its diameter and the wall between both, from points of a surface as a camera measures it."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.geometry.primitives import Cylinder
from recon.segmentation import tube_cover

AXIS = np.array([0.9, 0.1, 0.2]) / np.linalg.norm([0.9, 0.1, 0.2])
MIDDLE = np.array([5.0, -8.0, 660.0])
TUBE = Cylinder("", MIDDLE, AXIS, 7.91)
ENDS = MIDDLE + np.outer([-25.0, 25.0], AXIS)


def surface(outer: Cylinder, rng, noise_mm: float = 0.02, waves_mm: float = 0.0) -> trimesh.Trimesh:
    """Points on the side of a cylinder that faces the camera, 160 mm long, and a table behind it."""
    turn = np.linalg.svd(outer.axis[:, None])[0]
    angle = rng.uniform(0, 2 * np.pi, 60_000)
    round_about = np.column_stack([np.cos(angle), np.sin(angle)]) @ turn[:, 1:].T
    along = rng.uniform(-80, 80, len(angle))[:, None]
    points = outer.point + along * outer.axis + (outer.radius + waves_mm * np.sin(along / 3)) * round_about
    points = points[(round_about * points).sum(axis=1) < 0]
    points += rng.normal(0, noise_mm, points.shape)
    table = np.column_stack([rng.uniform(-120, 120, (20_000, 2)), np.full(20_000, outer.point[2] + outer.radius)])
    vertices = np.vstack([points, table])
    return trimesh.Trimesh(vertices, np.zeros((0, 3), int), process=False)


@pytest.mark.parametrize("offset_mm", [0.0, 0.3, -4.0])
def test_diameter_and_wall(rng, offset_mm):
    """The wall is the outer radius less the inner one and less the offset of the axes towards the camera."""
    towards = tube_cover.to_camera(TUBE)
    outer = Cylinder("", MIDDLE + offset_mm * towards + 30 * AXIS, AXIS, 30.0)
    found = tube_cover.fit_cover(surface(outer, rng), TUBE, ENDS)
    assert found.shape.radius == pytest.approx(30.0, abs=0.005)
    assert found.wall_mm == pytest.approx(30.0 - 7.91 + offset_mm, abs=0.005)
    assert found.rms_mm == pytest.approx(0.02, rel=0.1)


def test_a_tilted_body_has_its_wall_on_the_way_to_the_camera(rng):
    """Against the intersection of the ray with the outer cylinder, found by bisection."""
    turn = Rotation.from_rotvec(np.deg2rad([0.0, 4.0, 6.0]))
    outer = Cylinder("", MIDDLE + np.array([1.0, 2.0, -3.0]), turn.apply(AXIS), 30.0)
    low, high, towards = 0.0, 100.0, tube_cover.to_camera(TUBE)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if outer.distance(MIDDLE + middle * towards) < 0 else (low, middle)
    assert tube_cover.wall_between(outer, TUBE) == pytest.approx(low - TUBE.radius, abs=1e-9)
    assert tube_cover.fit_cover(surface(outer, rng), TUBE, ENDS).wall_mm == pytest.approx(low - TUBE.radius, abs=0.005)


def test_points_far_off_count_nothing(rng):
    """A twentieth of the points, some millimetres before the body, as flying pixels at edges are."""
    outer = Cylinder("", MIDDLE, AXIS, 30.0)
    mesh = surface(outer, rng)
    flying = rng.random(len(mesh.vertices)) < 0.05
    mesh.vertices[flying] -= rng.uniform(1, 8, flying.sum())[:, None] * [0.0, 0.0, 1.0]
    assert tube_cover.fit_cover(mesh, TUBE, ENDS).shape.radius == pytest.approx(30.0, abs=0.01)


def test_what_is_no_round_body_about_the_tube_is_refused(rng):
    outer = Cylinder("", MIDDLE, AXIS, 30.0)
    with pytest.raises(InputError, match="expected 1000 points before the tube, found 0"):
        tube_cover.fit_cover(surface(outer, rng), TUBE, ENDS + 300 * AXIS)
    with pytest.raises(InputError, match=r"expected a round body about the tube, found .* mm RMS off a cylinder"):
        tube_cover.fit_cover(surface(outer, rng, waves_mm=3.0), TUBE, ENDS)
    flat = np.column_stack([rng.uniform(-60, 60, (20_000, 2)), 630 + rng.normal(0, 0.02, 20_000)])
    with pytest.raises(InputError, match="expected a round body about the tube, found"):
        tube_cover.fit_cover(trimesh.Trimesh(flat, np.zeros((0, 3), int), process=False), TUBE, ENDS)
    dome = rng.normal(size=(60_000, 3))
    dome = MIDDLE + 60 * dome / np.linalg.norm(dome, axis=1, keepdims=True)
    with pytest.raises(InputError, match=r"expected a round body about the tube, found .* mm RMS off a cylinder"):
        tube_cover.fit_cover(trimesh.Trimesh(dome, np.zeros((0, 3), int), process=False), TUBE, ENDS)
    crossing = Cylinder("", MIDDLE, np.cross(AXIS, tube_cover.to_camera(TUBE)), 30.0)
    with pytest.raises(InputError, match="turned by 90 deg"):
        tube_cover.fit_cover(surface(crossing, rng), TUBE, ENDS)
    with pytest.raises(InputError, match=r"found its wall 2\.0 mm outside"):
        tube_cover.wall_between(outer, Cylinder("", MIDDLE + 24.09 * tube_cover.to_camera(TUBE), AXIS, 7.91))
    with pytest.raises(InputError, match="found its axis beside the body"):
        tube_cover.wall_between(outer, Cylinder("", MIDDLE + np.array([0.0, 31.0, 0.0]), AXIS, 7.91))
