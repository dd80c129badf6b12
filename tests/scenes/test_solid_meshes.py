"""Meshes against the shapes they stand for."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from scenes import solid_meshes

radii = st.floats(1.0, 60.0)


@settings(max_examples=15, deadline=None)
@given(radius=radii)
@example(radius=56.5)  # where a subdivision is only just enough
def test_a_ball_is_a_sphere_within_tolerance(radius):
    """Vertices lie on the sphere; the middle of a facet is where it dips deepest."""
    mesh = solid_meshes.ball(radius)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), radius, rtol=1e-9)
    sag = radius - np.linalg.norm(mesh.triangles_center, axis=1)
    assert sag.min() >= 0 and sag.max() < solid_meshes.TOLERANCE_MM


@settings(max_examples=15, deadline=None)
@given(radius=radii, length=st.floats(5.0, 300.0))
def test_a_rod_is_a_cylinder_within_tolerance(radius, length):
    mesh = solid_meshes.rod(radius, length)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert np.ptp(mesh.vertices[:, 0]) == pytest.approx(length)
    middles = mesh.vertices[mesh.edges_unique].mean(axis=1)  # of the edges: facets dip deepest there
    wall = np.abs(middles[:, 0]) < length / 2 - 1e-9
    sag = radius - np.hypot(middles[wall, 1], middles[wall, 2])
    assert sag.max() < solid_meshes.TOLERANCE_MM + 1e-9 and sag.min() > -1e-9


def test_normals_of_a_rod_are_radial_up_to_its_ends():
    """Interpolated normals must not bend towards the caps, or the ends would shade as if they were round."""
    mesh = solid_meshes.rod(30.0, 160.0)
    wall = (np.hypot(*mesh.vertices[:, 1:].T) > 29.9999) & (np.abs(mesh.vertices[:, 0]) < 80 - 1e-9)
    assert wall.any() and np.abs(mesh.vertex_normals[wall, 0]).max() < 1e-6
    assert np.abs(np.abs(mesh.vertices[wall, 0]) - 80).max() < 0.1


@settings(max_examples=30, deadline=None)
@given(
    size=st.tuples(st.floats(1, 400), st.floats(1, 400)),
    cells=st.tuples(st.integers(1, 6), st.integers(1, 6)),
    thickness=st.floats(0.5, 50),
)
def test_a_slab_has_the_volume_of_its_box(size, cells, thickness):
    mesh = solid_meshes.slab(*solid_meshes.grid(size, cells), thickness)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(size[0] * size[1] * thickness)
    assert mesh.bounds[:, 2].tolist() == [0, thickness]  # the front faces the camera, the body lies behind


def test_a_slab_keeps_its_holes():
    points, triangles = solid_meshes.grid((30, 30), (3, 3))
    middle = np.linalg.norm(points[triangles].mean(axis=1), axis=1) < 5
    mesh = solid_meshes.slab(points, triangles[~middle], 2)
    assert mesh.is_watertight and mesh.volume == pytest.approx(2 * (900 - 100))
    assert mesh.euler_number == 0  # a ring
