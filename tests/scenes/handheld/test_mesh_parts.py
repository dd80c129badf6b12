"""Joining parts: flat ones keep sharp edges, smooth ones curved normals, and every vertex knows its surface."""

import numpy as np
import pytest
import trimesh

from scenes.handheld import lofts
from scenes.handheld.mesh_parts import SLOTS, Part, merged


def test_an_unknown_slot_is_refused():
    with pytest.raises(ValueError, match="slot"):
        Part("velvet", lofts.box([1, 1, 1]), False)


def test_flat_parts_have_face_normals_and_smooth_ones_their_vertices():
    box, ball = lofts.box([10, 20, 30]), trimesh.creation.icosphere(subdivisions=2, radius=7)
    joint = merged([Part("table", box, False), Part("phantom", ball, True)])
    flat = joint.slot == SLOTS.index("table")
    assert flat.sum() == 3 * len(box.faces) and (~flat).sum() == len(ball.vertices)
    assert np.allclose(np.sort(np.abs(joint.normals[flat]), axis=1), [0, 0, 1])
    radial = joint.vertices[~flat] / np.linalg.norm(joint.vertices[~flat], axis=1, keepdims=True)
    assert ((joint.normals[~flat] * radial).sum(axis=1) > 0.999).all()


def test_faces_stay_within_their_slot_and_face_as_their_normals_do():
    parts = [Part("probe", lofts.rod(5, 30), True), Part("metal", lofts.box([3, 3, 3], [20, 0, 0]), False)]
    joint = merged(parts)
    assert joint.faces.dtype == np.uint32 and joint.vertices.dtype == joint.normals.dtype == np.float32
    slots = joint.slot[joint.faces]
    assert (slots == slots[:, :1]).all()
    corners = joint.vertices[joint.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((across * joint.normals[joint.faces].sum(axis=1)).sum(axis=1) > 0).all()


def test_nothing_merges_to_nothing():
    assert merged([]).faces.shape == (0, 3)
