"""A wall and a sphere from end to end: `sonotwin sweep path=tilts` and `calibrate-probe phantom=wall` and `phantom=sphere`."""

import json

import numpy as np
import pytest

from recon.capture import probe_files
from recon.probe_calibration import point_calibration, repeatability
from sonotwin.cli import main
from tests.recon import bscans
from tests.recon.probe_motions import true_probe

WATER_C = 22.0
TRACKER = ("pose_noise.shift_mm=0.05", "pose_noise.turn_deg=0.05")


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """Of a plate and of a ball, 60 poses each."""
    folder = tmp_path_factory.mktemp("surfaces")
    for scene in ("plane", "sphere"):
        fields = [f"scene={scene}", "ultrasound=water", "path=tilts", "path.count=60", *TRACKER, f"out={folder / scene}"]
        assert main(["sweep", *fields]) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "fields", "most_mm"), [
    ("plane", ["phantom=wall"], 0.8),
    ("sphere", ["phantom=sphere", "sphere_radius_mm=19.8"], 0.25),
])  # fmt: skip
def test_rendered_surfaces_calibrate_the_probe(scene, fields, most_mm, captures, rig, tmp_path, capsys):
    """At corners and in the middle, within what sigma leaves open.

    A wall's depth goes with the shift of echoes in a thick slice: 0.26 mm of sigma, of which the bar is three.
    """
    given = [f"capture={captures / scene / 'capture'}", f"temperature_c={WATER_C}", "lag_s=0.05", f"out={tmp_path / 'probe'}"]
    assert main(["calibrate-probe", *fields, *given]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert {"held", "surface"} <= {line.split()[0] for line in lines}
    assert not any(line.startswith("warning") for line in lines)
    found, true = probe_files.read(tmp_path / "probe" / "probe.yaml"), true_probe(rig)
    pixels = repeatability.five_points(bscans.SIZE)
    off = found.to_target(pixels) - true.to_target(pixels)
    assert np.linalg.norm(off, axis=1).max() < most_mm
    covariance = point_calibration.point_covariance(found, pixels)
    assert np.abs(off / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))).max() < 4
    figures = json.loads((tmp_path / "probe" / "metrics.json").read_text())
    assert figures["frames_rejected"] < 6 and figures["frames_outliers"] < 6
    assert figures["held_out_rms_mm"] < 0.15
    assert abs(figures["mirror_share"]) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "fields", "said"), [
    ("plane", ["phantom=sphere", "sphere_radius_mm=19.8"], "a straight line; a wall? give phantom=wall"),
    ("sphere", ["phantom=wall"], "a sphere? give phantom=sphere"),
    ("plane", [], "expected 6 frames or more with a pose and the crossing"),
    ("sphere", ["phantom=n_wires"], "expected 8 frames or more with a pose and the dots of all wires"),
    ("sphere", ["phantom=sphere"], "sphere_radius_mm: expected the sphere's radius in mm, found none"),
    ("sphere", ["phantom=sphere", "sphere_radius_mm=39.6"], "sphere"),
])  # fmt: skip
def test_another_phantom_than_given_is_refused(scene, fields, said, captures, tmp_path, capsys):
    out = tmp_path / "probe"
    assert main(["calibrate-probe", *fields, f"capture={captures / scene / 'capture'}", "lag_s=0.05", f"out={out}"]) == 2
    assert said in capsys.readouterr().err
    assert not out.exists()
