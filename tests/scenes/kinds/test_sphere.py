"""The sphere and what stands behind it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenes.kinds import sphere


def test_the_mesh_is_the_papers_sphere_within_two_micrometres():
    thing = sphere.build(sphere.Config()).things[0]
    assert thing.primitive.radius == 19.8
    distance = np.linalg.norm(np.concatenate([thing.mesh.vertices, thing.mesh.triangles_center]) - thing.primitive.centre, axis=1)
    assert np.abs(distance - 19.8).max() < 0.002


@settings(max_examples=10, deadline=None)
@given(radius=st.floats(2, 30), centre=st.tuples(st.floats(-80, 80), st.floats(-80, 80), st.floats(600, 670)))
def test_mesh_primitive_and_shape_are_one_sphere(radius, centre):
    scene = sphere.build(sphere.Config(radius_mm=radius, centre_mm=centre))
    thing, shape = scene.things[0], scene.shapes[0]
    assert thing.primitive is shape
    np.testing.assert_allclose(thing.mesh.bounds.mean(axis=0), centre, atol=1e-9)
    np.testing.assert_allclose(thing.mesh.volume, 4 / 3 * np.pi * radius**3, rtol=4 * 0.001 / radius)


def test_the_background_can_be_left_out():
    assert [thing.name for thing in sphere.build(sphere.Config(background_mm=None)).things] == ["sphere"]
    background = sphere.build(sphere.Config()).things[1].mesh
    assert background.bounds[0, 2] == pytest.approx(710)
