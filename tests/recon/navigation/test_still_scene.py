"""The skin of the view has its front outside, however its file winds the triangles."""

import numpy as np
import pytest
import trimesh

from recon.navigation.still_scene import outside_out
from tests.recon.skin_projection.skin_shapes import dome


@pytest.mark.parametrize("inverted", [False, True])
def test_the_front_of_a_skin_is_towards_camera_1(inverted):
    skin = dome(step=4.0)
    if inverted:
        skin.invert()
    turned = outside_out(skin)
    towards = (np.asarray(turned.face_normals) * -np.asarray(turned.triangles_center)).sum(axis=1)
    assert (towards > 0).mean() > 0.95
    assert len(turned.faces) == len(skin.faces)


def test_a_closed_skin_is_left_as_it_is():
    closed = trimesh.creation.icosphere(3, 60.0).apply_translation([0, 0, 700])
    assert outside_out(closed) is closed
