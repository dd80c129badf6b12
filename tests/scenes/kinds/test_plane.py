"""The plate and the paper's five poses."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from recon.model.rig import Rig
from scenes.kinds import plane

RIG = Path(__file__).parents[3] / "conf" / "rig" / "meza2021.yaml"


@pytest.fixture(scope="module")
def border_rays():
    """Rays of camera 1 through the border of its image, lens distortion and all."""
    camera = Rig(**yaml.safe_load(RIG.read_text())).cam1.optics.camera()
    width, height = camera.size
    u, v = np.linspace(-0.5, width - 0.5, 33), np.linspace(-0.5, height - 0.5, 33)
    sides = [(u, 0 * u - 0.5), (u, 0 * u + height - 0.5), (0 * v - 0.5, v), (0 * v + width - 0.5, v)]
    return camera.rays(np.concatenate([np.column_stack(side) for side in sides]))


def front(config):
    """Corners of the front face, mm in the world."""
    return plane.build(config).things[0].mesh.vertices[:4]


@given(
    centre=st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(500, 900)),
    tilt=st.tuples(st.floats(-60, 60), st.floats(-60, 60)),
)
def test_the_front_face_lies_in_the_plane_to_be_fitted(centre, tilt):
    scene = plane.build(plane.Config(centre_mm=centre, tilt_deg=tilt))
    shape, mesh = scene.shapes[0], scene.things[0].mesh
    height = (mesh.vertices - shape.point) @ shape.normal
    assert np.abs(height[:4]).max() < 1e-9
    np.testing.assert_allclose(height[4:], -plane.THICKNESS_MM, atol=1e-9)  # behind, away from the camera
    np.testing.assert_allclose(mesh.vertices[:4].mean(axis=0), centre, atol=1e-9)


def test_tilts_turn_the_right_way():
    """About x: the lower edge (y down) comes nearer for a negative angle. About y: the right edge for a positive one."""
    corners = front(plane.Config(tilt_deg=(-10, 0)))
    assert corners[np.argmax(corners[:, 1]), 2] < 660
    corners = front(plane.Config(tilt_deg=(0, 10)))
    assert corners[np.argmax(corners[:, 0]), 2] < 660


@pytest.mark.parametrize("pose", plane.PAPER_POSES)
def test_paper_poses_fill_the_view_within_reach(pose, border_rays):
    corners = front(pose)
    assert corners[:, 2].min() > 600 and corners[:, 2].max() < 720
    shape = plane.build(pose).shapes[0]
    hits = border_rays * ((shape.point @ shape.normal) / (border_rays @ shape.normal))[:, None]
    across = (hits - pose.centre_mm) @ plane.tilted(pose.centre_mm, pose.tilt_deg)[:3, :3]
    assert np.all(np.abs(across[:, 0]) < pose.size_mm[0] / 2 - 2)  # 2 mm to spare for a camera that is a little elsewhere
    assert np.all(np.abs(across[:, 1]) < pose.size_mm[1] / 2 - 2)


def test_paper_poses_span_the_papers_depth(border_rays):
    """606 to 713 mm over what camera 1 sees; our own choice of poses meets the ends within 3 mm."""
    depths = []
    for pose in plane.PAPER_POSES:
        shape = plane.build(pose).shapes[0]
        depths.append(border_rays[:, 2] * (shape.point @ shape.normal) / (border_rays @ shape.normal))
    assert np.min(depths) == pytest.approx(606, abs=3)
    assert np.max(depths) == pytest.approx(713, abs=3)
    assert len(plane.PAPER_POSES) == 5
