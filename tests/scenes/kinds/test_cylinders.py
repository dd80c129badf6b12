"""The paper's cylinders: radii, wall and rest on the table."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenes.kinds import cylinders


@settings(max_examples=15, deadline=None)
@given(outer=st.floats(40, 80), ratio=st.floats(0.1, 0.5), share=st.floats(0.05, 0.95))
def test_the_wall_towards_the_camera_is_as_asked(outer, ratio, share):
    inner = ratio * outer
    wall = share * (outer - inner)
    scene = cylinders.build(cylinders.Config(outer_diameter_mm=outer, inner_diameter_mm=inner, wall_mm=wall))
    outside, inside, table = (thing.mesh for thing in scene.things)
    # the mesh is within 0.001 mm of the cylinder, at both walls
    assert inside.bounds[0, 2] - outside.bounds[0, 2] == pytest.approx(wall, abs=0.003)
    assert outside.bounds[1, 2] == pytest.approx(table.bounds[0, 2], abs=0.002)
    assert np.all(inside.bounds[0] > outside.bounds[0]) and np.all(inside.bounds[1] < outside.bounds[1])


def test_the_papers_figures():
    scene = cylinders.build(cylinders.Config())
    outer, inner = scene.shapes
    assert (2 * outer.radius, 2 * inner.radius) == (60.0, 15.82)
    assert (inner.point[2] - inner.radius) - (outer.point[2] - outer.radius) == pytest.approx(22.38)
    assert [thing.inside for thing in scene.things] == [False, True, False]


@pytest.mark.parametrize("k", [0, 1])
def test_the_meshes_lie_on_the_shapes(k):
    scene = cylinders.build(cylinders.Config())
    shape, mesh = scene.shapes[k], scene.things[k].mesh
    away = np.concatenate([mesh.vertices, mesh.vertices[mesh.edges_unique].mean(axis=1)]) - shape.point
    wall = np.abs(away[:, 0]) < np.abs(away[:, 0]).max() - 1e-6
    distance = np.linalg.norm(away - np.outer(away @ shape.axis, shape.axis), axis=1)[wall]
    assert np.abs(distance - shape.radius).max() < 0.005
