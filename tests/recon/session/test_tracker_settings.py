"""The tracker as the fields of verbs."""

import subprocess
import sys

import numpy as np
import pytest

from recon.capture import target_files
from recon.capture.manifest import CAMERAS
from recon.errors import InputError
from recon.session.tracker_settings import BodyFields, MeasuredTargetFields, make_tracker, target_of, targets_of
from sonotwin import choices


@pytest.fixture(scope="module")
def cameras(rig):
    return rig.cam1.optics.camera(), rig.cam2.optics.camera()


def test_cameras_may_have_drifted_and_their_board_may_have_stretched(rig, cameras):
    """Without a covariance of the calibration the optics are as uncertain as the fields say, and exact where these are 0."""
    fields = MeasuredTargetFields(rig=rig, drift_px=0.2, board_scale=1e-3, threads=1)
    optics = make_tracker(fields, rig.target, cameras, None, None).optics_in_use
    sigma = dict(zip(optics.names, np.sqrt(np.diag(optics.covariance)), strict=True))
    baseline = np.sqrt(sum(sigma[f"cam2.{axis}"] ** 2 for axis in ("tx", "ty", "tz")))
    assert [sigma[f"{name}.{axis}"] for name in CAMERAS for axis in ("cx", "cy")] == pytest.approx([0.2] * 4)
    assert baseline == pytest.approx(1e-3 * np.linalg.norm(cameras[1].camera_from_world[:3, 3]))
    exact = fields.model_copy(update={"drift_px": 0.0, "board_scale": 0.0})
    assert make_tracker(exact, rig.target, cameras, None, None).optics_in_use is None


def test_the_target_is_the_measured_one_where_there_is_one(rig, tmp_path):
    measured = rig.target.model_copy(update={"c1_mm": 25.1})
    target_files.write(tmp_path / "target.yaml", measured, 1e-4 * np.eye(7))
    fields = MeasuredTargetFields(rig=rig)
    assert target_of(fields) == rig.target
    assert target_of(fields.model_copy(update={"target": tmp_path / "target.yaml"})).c1_mm == pytest.approx(25.1)


def test_a_missing_network_is_named(rig, cameras, tmp_path):
    with pytest.raises(InputError, match=str(tmp_path / "detector.onnx")):
        make_tracker(MeasuredTargetFields(rig=rig, networks=tmp_path), rig.target, cameras, None, None)


def test_steps_without_a_tracker_wait_for_none():
    """The runtime of networks takes a tenth of a second to import, and isn't asked for by those who segment or fuse."""
    program = "import sys, recon.session.masses_step, recon.session.probe_step; print('onnxruntime' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_bodies_have_their_measured_targets(tmp_path):
    """By name; a file for a body that the rig doesn't have is refused with the name that may be meant."""
    rig = choices.read_rig("three_bodies")
    design = rig.bodies["needle"]
    target_files.write(tmp_path / "needle.yaml", design.model_copy(update={"c1_mm": 24.05}), 1e-4 * np.eye(7))
    fields = BodyFields(rig=rig, measured={"needle": tmp_path / "needle.yaml"})
    found = targets_of(fields)
    assert list(found) == ["probe", "needle", "patient"] and found["patient"] == rig.bodies["patient"]
    assert found["needle"].c1_mm == pytest.approx(24.05) and found["needle"].covariance_mm2 is not None
    with pytest.raises(
        InputError, match=r"measured\.nedle: expected one of rig\.bodies, needle, patient.*found nedle; did you mean needle"
    ):
        targets_of(fields.model_copy(update={"measured": {"nedle": tmp_path / "needle.yaml"}}))
    other = rig.bodies["needle"].model_copy(update={"c1_mm": 26.5})
    target_files.write(tmp_path / "other.yaml", other, 1e-4 * np.eye(7))
    with pytest.raises(InputError, match=r"measured\.needle: .*expected its design to 1 mm, found c1_mm off by \+2\.50 mm"):
        targets_of(fields.model_copy(update={"measured": {"needle": tmp_path / "other.yaml"}}))
