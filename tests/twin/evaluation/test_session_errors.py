"""Errors of a session: a face that stands off the skin by light is found, whatever the hand did."""

import json

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


def test_errors_of_the_cylinders(tmp_path):
    """Found less true; the wall is that between the outer one of the surface and the inner one of the sweep."""
    parts = {"surface": {"kind": "cylinders"}, "sweep/tube": {"kind": "inner_cylinder", "centre_mm": [4.0, -2.0, 670.29]}}
    for part, scene in parts.items():
        (tmp_path / "truth" / part).mkdir(parents=True)
        for name, content in (("scene.json", {}), ("settings.json", {"scene": scene})):
            (tmp_path / "truth" / part / name).write_text(json.dumps(content))
    found = {"tube_diameter_mm": 15.8, "cover_diameter_mm": 60.01, "cover_wall_mm": 22.4, "tube_diameter_sigma_mm": 0.03}
    (tmp_path / "tube" / "tube").mkdir(parents=True)
    (tmp_path / "tube" / "tube" / "metrics.json").write_text(json.dumps(found))
    errors = session_errors.cylinders(tmp_path, tmp_path / "truth", "tube")
    assert errors["tube_diameter_error_mm"] == pytest.approx(-0.02) and errors["cover_diameter_error_mm"] == pytest.approx(0.01)
    assert errors["cover_wall_error_mm"] == pytest.approx(0.02, abs=2e-3)
