"""`sonotwin correct-optics`: fringes before two cameras, one of which drifted; what shows none, or more than drift, is named."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.capture import calibration_files
from recon.files import metrics
from recon.model.calibration import Calibration, Uncertainty
from recon.model.rig import Rig
from recon.tracking.pose_fit import meet
from sonotwin.cli import main
from tests.recon.tracking import films
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
    assert "more than 8 times as much: was one pushed?" in error and error.count("\n") == 1 and not (tmp_path / "out").exists()


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


def test_a_film_alone_shows_a_camera_that_drifted_across_the_other(rig, tmp_path, capsys):
    """By 0.3 px along the columns, six times the usual: rays of the target's circles miss each other, and meet again.

    The film is the capture's only sweep, without a name.
    """
    films.film(tmp_path / "film", rig, np.random.default_rng(4), count=6)
    true = calibration_of(rig).cameras
    matrix = true["cam2"].matrix + np.array([[0, 0, 0], [0, 0, 0.3], [0, 0, 0]])
    wrong = {**true, "cam2": replace(true["cam2"], matrix=matrix)}
    calibration_files.write(tmp_path / "optics.yaml", Calibration({name: wrong[name] for name in ("cam1", "cam2")}))
    line = [f"capture={tmp_path / 'film'}", f"calibration={tmp_path / 'optics.yaml'}", f"out={tmp_path / 'out'}"]
    assert main(["correct-optics", *line]) == 0
    said = capsys.readouterr().out
    assert "fringes     none before cam1 and cam2" in said and "3 views by both cameras, out of 6" in said  # 2 mm apart
    points = np.random.default_rng(5).uniform([-40, -40, 640], [40, 40, 680], (20, 3))
    seen = [true[name].project(points) for name in ("cam1", "cam2")]

    def missed_px(file) -> float:
        """Mean distance of cam2's rays from where both meet, along the columns."""
        cameras = calibration_files.read(file).cameras
        met = meet([cameras[name] for name in ("cam1", "cam2")], seen)[0]
        return float(abs(np.mean((cameras["cam2"].project(met) - seen[1])[:, 1])))

    assert missed_px(tmp_path / "optics.yaml") > 0.1 and missed_px(tmp_path / "out/optics.yaml") < 0.02


def test_a_calibration_of_one_camera_and_the_projector_leaves_drift_out(drifted, tmp_path, capsys):
    """As the rig authors' files are: the skin is camera 1's, and nothing has failed."""
    known = calibration_files.read(drifted / "optics.yaml").cameras
    calibration_files.write(tmp_path / "pair.yaml", Calibration({name: known[name] for name in ("cam1", "projector")}))
    line = [f"capture={drifted / 'capture'}", f"calibration={tmp_path / 'pair.yaml'}", f"out={tmp_path / 'result'}"]
    assert main(["reconstruct", *line]) == 0
    said = capsys.readouterr().out
    assert "left out    drift: no calibration of cam2" in said and "cam2 isn't compared: it has no calibration" in said


@pytest.fixture(scope="module")
def bar(rig, drifted):
    """A capture of a ball bar by the same cameras, and a calibration by a board that was printed smaller by a thousandth."""
    scene = ["scene=ball_bar", *SCENE[1:]]
    assert main(["render", *scene, *half_as_fields(moved(rig, 2 * DRIFT_PX)), f"out={drifted / 'bar'}"]) == 0
    made = calibration_files.read(drifted / "optics.yaml")
    larger = {}
    for name, camera in made.cameras.items():
        place = camera.camera_from_world.copy()
        place[:3, 3] *= 1.001
        larger[name] = replace(camera, camera_from_world=place)
    names = tuple(f"{device}.{axis}" for device in ("cam2", "projector") for axis in ("cx", "cy"))
    known = Uncertainty(names, 0.05**2 * np.eye(len(names)))
    calibration_files.write(drifted / "larger.yaml", Calibration(larger, known))
    return drifted / "bar/capture"


def test_a_ball_bar_tells_the_scale(drifted, bar, tmp_path, capsys):
    """A board's print off by 1e-3 comes down to 2e-4; later steps keep what is known of it."""
    out, fields = tmp_path / "out", [f"bars=[{bar}]", "bar_mm=[150.0,0.005]", "board_scale=1e-3"]
    assert correct(drifted, out, drifted / "larger.yaml", *fields) == 0
    said, sigma = capsys.readouterr().out, 1e-6 * metrics.read(out / "metrics.json")["scale_sigma_ppm"]
    assert "bar         150.1" in said and "scale       known to " in said
    found = calibration_files.read(out / "optics.yaml")
    true = calibration_files.read(drifted / "truth/calibration/optics.yaml").cameras
    baselines = [np.linalg.norm(cameras["projector"].centre) for cameras in (found.cameras, true)]
    assert abs(baselines[0] / baselines[1] - 1) < 2e-4 and sigma < 1.5e-4
    assert found.uncertainty.has_scale


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        (["bars=[BAR]"], "bar_mm: expected beside bars, found nothing"),
        (["bar_mm=[150.0,0.005]"], "bars: expected beside bar_mm, found nothing"),
        (["bars=[BAR]", "bar_mm=[150.0,0.005]", "ball_mm=40"], "expected two balls of 40 mm before cam1 and projector, found "),
        (["bars=[SKIN]", "bar_mm=[150.0,0.005]"], "expected two balls of 25.4 mm before cam1 and projector, found "),
        (["bars=[BAR,BAR]", "bar_mm=[150.0,0.005]"], "bars: expected each capture once, found one twice"),
        (["bars=[BAR]", "bar_mm=[150.0,150.0]"], "bar_mm: expected a length and its standard deviation, at most 1 % of it"),
        (["bars=[BAR]", "bar_mm=[151.5,0.005]"], "bar_mm: expected a bar's length by calibration and usual drift, found 150."),
        (["bars=[nowhere]", "bar_mm=[150.0,0.005]"], "nowhere: expected a capture, found no such folder"),
    ],
)
def test_a_bar_that_is_none_is_refused(drifted, bar, tmp_path, capsys, fields, complaint):
    given = [field.replace("BAR", str(bar)).replace("SKIN", str(drifted / "capture")) for field in fields]
    assert correct(drifted, tmp_path / "out", drifted / "larger.yaml", *given) == 2
    error = capsys.readouterr().err
    assert complaint in error and error.count("\n") == 1 and not (tmp_path / "out").exists()
