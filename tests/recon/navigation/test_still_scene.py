"""The skin of the view has its front outside, however its file winds the triangles."""

import numpy as np
import pytest
import trimesh

from recon.errors import InputError
from recon.files import meshes
from recon.model.tip import Tip
from recon.navigation.still_scene import outside_out, tool_shape
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


def test_a_tool_is_its_model_or_a_shaft_to_its_tip(tmp_path):
    """In the target's frame; of one whose tip isn't known there is its place alone."""
    path = tmp_path / "needle.ply"
    meshes.write_ply(path, trimesh.creation.box([2, 2, 90]))
    tip = Tip(np.array([3.0, -4, -150]), np.eye(3))
    assert tool_shape("needle", Tip(tip.tip_mm, tip.covariance, model=path)).extents == pytest.approx([2, 2, 90])
    shaft = tool_shape("needle", tip)
    ends = np.sort([np.zeros(3), tip.tip_mm], axis=0)
    np.testing.assert_allclose(shaft.bounds, ends, atol=2.0)  # radii of the shaft and of its end
    assert np.abs(tool_shape("needle", None).bounds).max() < 10
    with pytest.raises(InputError, match="expected a model of the needle"):
        tool_shape("needle", Tip(tip.tip_mm, tip.covariance, model=tmp_path / "none.stl"))
