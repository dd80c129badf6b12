"""`sonotwin correct-optics`: fringes before two cameras, one of which drifted; what shows none, or more than drift, is named."""

import json
import shutil

import cv2
import numpy as np
import pytest

from recon.capture import calibration_files
from recon.files import metrics
from recon.model.rig import Rig
from sonotwin.cli import main
from tests.twin.parting import parted_mm
from tests.twin.small_rigs import half, half_as_fields
from twin.optics.surface_session import calibration_of

DRIFT_PX = 0.15  # of camera 2's principal point, three times the usual: some 0.2 mm on the skin
SCENE = ["scene=breast", "patterns=gray_surface", "cameras=[cam1,cam2]", "tracing.samples=2"]


def moved(rig: Rig, px: float) -> Rig:
    """The rig with another principal point of camera 2."""
    x, y = rig.cam2.optics.centre_px
    optics = rig.cam2.optics.model_copy(update={"centre_px": (x + px, y)})
    return rig.model_copy(update={"cam2": rig.cam2.model_copy(update={"optics": optics})})


@pytest.fixture(scope="module")
def drifted(rig, tmp_path_factory):
    """A capture by cameras of half the size, and files of calibrations: as it was, and of a camera that was pushed since."""
    folder = tmp_path_factory.mktemp("drifted")
    assert main(["render", *SCENE, *half_as_fields(moved(rig, 2 * DRIFT_PX)), f"out={folder}"]) == 0
    calibration_files.write(folder / "optics.yaml", calibration_of(half(rig)))
    calibration_files.write(folder / "pushed.yaml", calibration_of(half(moved(rig, 12.0))))
    return folder


def correct(folder, out, calibration, *fields) -> int:
    return main(["correct-optics", f"capture={folder / 'capture'}", f"calibration={calibration}", f"out={out}", *fields])


def test_a_camera_that_drifted_is_corrected(drifted, tmp_path, capsys):
    """What parted skin and target by more than 0.1 mm is undone to less than a tenth; the page and the figures have it."""
    out = tmp_path / "out"
    assert correct(drifted, out, drifted / "optics.yaml") == 0
    before, after = (parted_mm(file, drifted / "truth") for file in (drifted / "optics.yaml", out / "optics.yaml"))
    assert before > 0.1 and after < 0.1 * before
    said, found = capsys.readouterr().out, metrics.read(out / "metrics.json")
    assert found["skin_moved_mm"] == pytest.approx(before, rel=0.2) and found["skin_sigma_mm"] < 0.02
    assert found["matches"] > 300 and found["views"] == 0
    assert f"by {found['skin_moved_mm']:.3f} mm uncorrected" in said
    assert "principal point, x" in (out / "drift.html").read_text(encoding="utf-8")
    assert (
        main(["surface", f"capture={drifted / 'capture'}", f"calibration={out / 'optics.yaml'}", f"out={tmp_path / 'skin'}"]) == 0
    )
    assert "fuse        cam2 measures" in capsys.readouterr().out


def test_without_a_correction_the_second_camera_improves_nothing(drifted, tmp_path, capsys):
    """By the calibration as it was, and says what would help."""
    line = [f"capture={drifted / 'capture'}", f"calibration={drifted / 'optics.yaml'}", f"out={tmp_path / 'skin'}"]
    assert main(["surface", *line]) == 0
    assert "warning     cam2 improves no point" in (said := capsys.readouterr().out) and "sonotwin correct-optics" in said


def test_a_camera_that_was_pushed_is_refused(drifted, tmp_path, capsys):
    assert correct(drifted, tmp_path / "out", drifted / "pushed.yaml") == 2
    error = capsys.readouterr().err
    assert "times as much or more: was one pushed?" in error and error.count("\n") == 1 and not (tmp_path / "out").exists()


def test_fringes_before_one_camera_show_no_drift(drifted, tmp_path, capsys):
    shutil.copytree(drifted / "capture", tmp_path / "capture")
    listed = json.loads((tmp_path / "capture/manifest.json").read_text())
    del listed["surface"]["images"]["cam2"]
    (tmp_path / "capture/manifest.json").write_text(json.dumps(listed))
    assert correct(tmp_path, tmp_path / "out", drifted / "optics.yaml") == 2
    captured = capsys.readouterr()
    assert "none before cam2" in captured.out and "expected fringes before cam1 and cam2" in captured.err
    line = [
        "reconstruct",
        f"capture={tmp_path / 'capture'}",
        f"calibration={drifted / 'optics.yaml'}",
        f"out={tmp_path / 'result'}",
    ]
    assert main(line) == 0
    assert "left out    drift: fringes before one camera alone" in capsys.readouterr().out


def test_a_dark_second_camera_is_named_and_the_result_is_that_of_the_first(drifted, tmp_path, capsys):
    """Its lens was capped: the surface is camera 1's, byte for byte, and the correction is named as failed, by the status too."""
    shutil.copytree(drifted / "capture", tmp_path / "dark/capture")
    for path in (tmp_path / "dark/capture/surface/cam2").glob("*.png"):
        cv2.imwrite(str(path), np.full((512, 640), 3, np.uint8))
    surfaces = {}
    for name, capture in (("dark", tmp_path / "dark/capture"), ("alone", tmp_path / "alone/capture")):
        if name == "alone":
            shutil.copytree(tmp_path / "dark/capture", capture)
            listed = json.loads((capture / "manifest.json").read_text())
            del listed["surface"]["images"]["cam2"]
            (capture / "manifest.json").write_text(json.dumps(listed))
        line = [f"capture={capture}", f"calibration={drifted / 'optics.yaml'}", f"out={tmp_path / name / 'result'}"]
        assert main(["reconstruct", *line]) == (1 if name == "dark" else 0)
        surfaces[name] = (tmp_path / name / "result/surface/surface.ply").read_bytes()
        said = capsys.readouterr()
        assert ("cam2" in said.out + said.err) == (name == "dark")
    assert surfaces["dark"] == surfaces["alone"]
