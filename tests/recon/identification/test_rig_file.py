"""A rig's file with what was measured: it reads as it was, says what is known, and refuses what can't be."""

from datetime import date

import numpy as np
import pytest

from recon.errors import InputError, validated
from recon.identification import calibrated_optics, rig_file
from recon.identification.estimates import Estimate, Findings
from recon.model.calibration import Calibration, Uncertainty
from recon.model.rig import Rig
from sonotwin.choices import read_rig

FOUND = Findings(
    {
        "cam1.sensor.saturation_e": Estimate(8123.456, 45.6, "12 fringe images of cam1"),
        "cam1.optics.focal_px.0": Estimate(3301.25678, 0.31, "34 poses of the board"),
        "cam1.optics.focal_px.1": Estimate(3312.25678, 0.32, "34 poses of the board"),
        "conditions.frames.flicker": Estimate(0.01, 0.002, "12 fringe images of cam1"),
    },
    {"projector.contrast": "black and room light look alike: record a frame with the projector covered"},
)


def test_what_was_measured_stands_in_place_of_what_was_assumed(rig):
    found = rig_file.apply(rig, FOUND)
    assert found.cam1.sensor.saturation_e == 8123.456 and found.cam1.optics.focal_px == (3301.25678, 3312.25678)
    assert found.measured.keys() == {name for name in FOUND.estimates if name.startswith("cam1")}
    assert found.measured["cam1.sensor.saturation_e"].sigma == 45.6
    assert found.cam1.lens.focal_length_mm == pytest.approx(3301.25678 * 4.8e-3)
    assert found.projector == rig.projector and found.cam2.sensor == rig.cam2.sensor
    assert hash(found) != hash(rig)


def test_the_file_reads_as_it_was_written(rig, tmp_path):
    """Values are written to a digit beyond the second of their uncertainty."""
    found, path = rig_file.apply(rig, FOUND), tmp_path / "ours.yaml"
    rig_file.write(path, found, FOUND.unknown, "made up\nin a test")
    text, again = path.read_text(), read_rig(path)
    assert text.startswith("# made up\n# in a test\n")
    assert "    saturation_e: 8123.0  # ± 46: 12 fringe images of cam1\n" in text
    assert "focal_px: [3301.25678, 3312.25678]  # ± 0.31, 0.32: 34 poses of the board" in text
    assert "  contrast: 1000.0  # not measured: black and room light look alike" in text
    assert again.measured == found.measured and again.target == found.target and again.probe == found.probe
    for name, one in found.measured.items():
        assert again.number(name) == pytest.approx(found.number(name), abs=0.05 * one.sigma)


def test_each_identification_is_a_version_on_with_its_day_and_the_covariance_of_optics(rig, tmp_path):
    """The covariance to 12 digits, which leave its smallest axes as they are."""
    rng = np.random.default_rng(0)
    names = tuple(f"cam1.{name}" for name in ("fx", "fy", "cx", "cy", "k1"))
    root = rng.standard_normal((5, 5)) * [1, 1e-3, 1, 1, 1e-2]
    cameras = {name: getattr(rig, name).optics.camera() for name in ("cam1", "cam2", "projector")}
    known = Calibration(cameras, Uncertainty(names, root.T @ root, has_scale=True))
    found, path = calibrated_optics.with_devices(rig, known), tmp_path / "ours.yaml"
    for version in (1, 2):
        found = rig_file.next_version(found, "board on monday", date(2026, 5, 3 + version))
        rig_file.write(path, found, {}, "a test")
        found = read_rig(path)
        assert (found.version, str(found.identified.day)) == (version, f"2026-05-0{3 + version}")
        assert found.identified.capture == "board on monday"
    again = found.calibration().uncertainty
    assert again.names == names
    assert again.covariance == pytest.approx(known.uncertainty.covariance, rel=1e-10, abs=0)
    assert hash(found) == hash(read_rig(path))


def test_a_damaged_covariance_is_refused(rig):
    content = rig.model_dump(mode="json") | {"optics_covariance": {"names": ["cam1.fx", "cam1.fy"], "rows": [[1.0], [0.0]]}}
    with pytest.raises(InputError, match=r"optics_covariance\.rows: expected a row a name, of 1 to 2 numbers, found \[1, 1\]"):
        validated(Rig, content, "ours.yaml")


def test_what_can_not_be_is_refused_by_name(rig):
    for name, value, told in (
        ("cam1.sensor.prnu", -0.5, "prnu"),
        ("cam1.sensor.colour", 1.0, "^rig: expected the name of one of its numbers, found cam1.sensor.colour$"),
        ("cam1.optics.focal_px.2", 1.0, "cam1.optics.focal_px.2"),
        ("cam1.lens", 1.0, "lens"),
    ):
        with pytest.raises(InputError, match=told):
            rig_file.apply(rig, Findings({name: Estimate(value, 0.1, "a test")}))
