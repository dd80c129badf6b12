"""The rig's description loads, means what it says, and refuses nonsense by the field's name."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from pydantic import ValidationError

from recon.model.rig import Pose, Rig

MEZA2021 = Path(__file__).parents[3] / "conf" / "rig" / "meza2021.yaml"


@pytest.fixture
def content() -> dict:
    return yaml.safe_load(MEZA2021.read_text(encoding="utf-8"))


def test_both_cameras_and_the_projector_look_at_the_working_volume(content):
    """The middle of the paper's volume, 660 mm in front of camera 1, is inside all three images; so are points 100 mm aside."""
    rig = Rig.model_validate(content)
    for device in (rig.cam1, rig.cam2, rig.projector):
        camera = device.optics.camera()
        pixels = camera.project([[0, 0, 660], [90, 0, 660], [-90, 0, 660], [0, 70, 660], [0, -70, 660]])
        assert (pixels > 0).all() and (pixels < camera.size).all()


def test_camera_1_is_the_world_and_the_baselines_are_as_planned(content):
    """150 to 200 mm from camera 1 to the other two."""
    rig = Rig.model_validate(content)
    assert np.array_equal(rig.cam1.optics.camera().camera_from_world, np.eye(4))
    for device in (rig.cam2, rig.projector):
        assert 150 < np.linalg.norm(device.optics.camera().centre) < 200


def test_a_pose_is_the_device_from_the_world():
    pose = Pose(rotation_deg=(0, 90, 0), translation_mm=(1, 2, 3)).matrix()
    assert np.allclose(pose @ [0, 0, 1, 1], [2, 2, 3, 1])


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("cam1.optics.size", [1280]),
        ("cam1.optics.focal_px", [-3320, 3331]),
        ("cam1.optics.centre_px", [float("nan"), 523]),
        ("cam2.optics.distortion", [0.1, 0.2, 0.3]),
        ("cam1.sensor.quantum_efficiency", 1.2),
        ("cam1.sensor.adc_bits", 7),
        ("projector.gamma", 0),
        ("projector.contrast", 1),
        ("projector.lens.vignetting", 2),
        ("target.inner_diameter_mm", 30),
        ("probe.scale_mm_per_px", [0.1, 0]),
        ("projector.lamp", 1),
    ],
)
def test_nonsense_is_refused_by_name(content, path, value):
    *parents, key = path.split(".")
    part = content
    for name in parents:
        part = part[name]
    part[key] = value
    with pytest.raises(ValidationError) as refusal:
        Rig.model_validate(content)
    assert ".".join(str(piece) for piece in refusal.value.errors()[0]["loc"]).startswith(path)
