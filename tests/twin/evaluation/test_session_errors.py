"""Errors of a session: a face that stands off the skin by light is found, whatever the hand did."""

import numpy as np
import pytest
import trimesh

from recon.geometry import rigid
from scenes.solid_meshes import grid
from twin.evaluation import session_errors
from twin.ultrasound.transducer import Transducer

TRANSDUCER = Transducer()
LOOKING_AWAY = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # world_from_image of a probe that looks along the world's z
PIXEL = np.diag([*TRANSDUCER.scale_mm_per_px, 1.0, 1.0])


def plane(depth_mm: float) -> trimesh.Trimesh:
    """A plane that faces the cameras."""
    points, triangles = grid((120.0, 120.0), (120, 120))
    vertices = np.column_stack([points, np.full(len(points), depth_mm)])
    upwards = trimesh.Trimesh(vertices, triangles, process=False).face_normals[0, 2] < 0
    return trimesh.Trimesh(vertices, triangles if upwards else triangles[:, ::-1], process=False)


class Truth:
    """What of a sweep's truth is needed."""

    transducer = TRANSDUCER
    skin = plane(650.0)

    def __init__(self, rng) -> None:
        places = np.column_stack([rng.uniform(-30, 0, 20), rng.uniform(-20, 20, 20), 650.0 - rng.uniform(0, 0.4, 20)])
        self.world_from_image = np.stack([rigid.transform(LOOKING_AWAY, place) for place in places])


@pytest.mark.parametrize("bias", [0.0, 0.2, -0.2])
def test_a_bias_between_light_and_sound_is_found(tmp_path, rng, bias):
    """The measured skin lies deeper by the bias, so the face seems to stand off it by as much, however the hand pressed."""
    plane(650.0 + bias).export(tmp_path / "surface.ply")
    truth = Truth(rng)
    found = session_errors.contact_bias(truth.world_from_image @ PIXEL, truth, tmp_path / "surface.ply")
    assert found == pytest.approx(bias, abs=1e-3)


def test_scans_without_a_pose_are_left_out(tmp_path, rng):
    plane(650.0).export(tmp_path / "surface.ply")
    truth = Truth(rng)
    placed = truth.world_from_image @ PIXEL
    placed[:5] = np.nan
    placed[5:, 2, 3] -= 0.3  # towards the cameras
    assert session_errors.contact_bias(placed, truth, tmp_path / "surface.ply") == pytest.approx(0.3, abs=1e-3)
