"""`sonotwin project`: the picture, the curves and the scene of what is given, and one line for what isn't there."""

import json
import time
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import trimesh

from recon.capture import calibration_files
from recon.files import meshes
from recon.geometry import rigid
from scenes.solid_meshes import grid
from sonotwin.cli import main
from sonotwin.verbs import project
from tests.recon import sweep_sets
from tests.recon.devices.x_server import x_server
from twin.experiments.virtual_screen import screenshot
from twin.optics.surface_session import calibration_of

BALL = np.array([2.0, -3.0, 680.0])
CUT = {"type": "Line", "controlPoints": [{"position": [-10.0, 20.0, 660.0]}, {"position": [10.0, 20.0, 660.0]}]}


def bent(motion=None):
    """A skin that is bent unlike in any two directions, moved."""
    points, triangles = grid((120.0, 100.0), (120, 100))
    x, y = points.T
    height = 660 + (x / 12) ** 2 + (y / 11) ** 2 - 5 * np.exp(-((x - 10) ** 2 + (y + 8) ** 2) / 40) + 2e-5 * x**3
    skin = trimesh.Trimesh(np.column_stack([x, y, height]), triangles[:, ::-1], process=False)
    return skin if motion is None else skin.apply_transform(motion)


@pytest.fixture
def given(rig, tmp_path):
    meshes.write_ply(tmp_path / "skin.ply", bent())
    (tmp_path / "masses").mkdir()
    meshes.write_ply(tmp_path / "masses" / "mass0.ply", trimesh.creation.icosphere(4, 8.0).apply_translation(BALL))
    (tmp_path / "cut.mrk.json").write_text(json.dumps({"markups": [CUT]}))
    calibration_files.write(tmp_path / "optics.yaml", calibration_of(rig))
    return [f"skin={tmp_path}/skin.ply", f"calibration={tmp_path}/optics.yaml", f"out={tmp_path}/out"]


def curves(folder):
    content = json.loads((folder / "curves.json").read_text())
    assert (content["schema"], content["unit"]) == ("sonotwin-curves/1", "mm")
    return {curve["name"]: np.concatenate(curve["pieces"]) for curve in content["curves"]}


def test_masses_and_a_cut_are_drawn_where_they_are(given, rig, tmp_path, capsys):
    assert main(["project", *given, f"masses={tmp_path}/masses", f"cut={tmp_path}/cut.mrk.json"]) == 0
    assert "mass0" in capsys.readouterr().out
    picture = cv2.imread(str(tmp_path / "out" / "projector.png"), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (800, 1280) and picture.dtype == np.uint8
    found = curves(tmp_path / "out")
    assert set(found) == {"mass0", "cut0"}
    v, u = np.rint(rig.projector.optics.camera().project(found["mass0"]).T[::-1]).astype(int)
    assert (picture[v, u] > 200).all()
    assert meshes.read_ply(tmp_path / "out" / "curves.ply", "strips").area == pytest.approx(np.pi * 16 + 20, rel=0.05)
    for name in ("scene.glb", "expected_cam1.png", "metrics.json"):
        assert (tmp_path / "out" / name).is_file()


@pytest.mark.parametrize(("names_mm", "warned"), [(5, False), (40, True), (0, False)])
def test_a_mass_without_room_for_its_name_is_said(given, tmp_path, capsys, names_mm, warned):
    assert main(["project", *given, f"masses={tmp_path}/masses", f"names_mm={names_mm}"]) == 0
    assert ("no room for the name of" in capsys.readouterr().out) == warned


def test_the_eye_sees_it_elsewhere_than_the_normal(given, tmp_path):
    masses = f"masses={tmp_path}/masses"
    assert main(["project", *given, masses]) == 0
    upright = curves(tmp_path / "out")["mass0"].mean(axis=0)
    assert main(["project", *given, masses, "eye_mm=[400,0,300]"]) == 0
    assert curves(tmp_path / "out")["mass0"].mean(axis=0)[0] > upright[0] + 5


def test_masses_move_along_with_the_skin(given, tmp_path, capsys):
    """The body was elsewhere when the mass was found: the outline is that of the mass moved back."""
    motion = rigid.from_rotation_vector([0.0, 0, 0.02], [-3.0, 2.0, -1.0])
    meshes.write_ply(tmp_path / "before.ply", bent(motion))
    still = [*given, f"masses={tmp_path}/masses"]
    assert main(["project", *still]) == 0
    expected = curves(tmp_path / "out")["mass0"]
    moved = trimesh.creation.icosphere(4, 8.0).apply_translation(BALL).apply_transform(motion)
    meshes.write_ply(tmp_path / "masses" / "mass0.ply", moved)
    assert main(["project", *still, f"earlier_skin={tmp_path}/before.ply"]) == 0
    said = capsys.readouterr().out
    assert "moved by" in said and "known to 0.0" in said
    found = curves(tmp_path / "out")["mass0"]
    nearest = np.linalg.norm(found[:, None] - expected, axis=2).min(axis=1)
    assert nearest.max() < 0.25, "0.15 mm along the curve between its points"


def test_the_probe_gets_a_line_and_no_light(given, rig, tmp_path):
    """The line of the B-scan is drawn, but not on the probe; without margin more is lit than with."""
    sweep_sets.ball(tmp_path / "capture", rig, lag_s=0.05)
    fields = [*given, f"capture={tmp_path}/capture", "lag_s=0.05", "scan=20", f"masses={tmp_path}/masses"]
    lit = {}
    for margin in (0, 2):
        assert main(["project", *fields, f"margin_mm={margin}"]) == 0
        lit[margin] = np.count_nonzero(cv2.imread(str(tmp_path / "out" / "projector.png"), cv2.IMREAD_UNCHANGED))
    assert 0 < lit[2] < lit[0]
    assert "scan0020" in curves(tmp_path / "out")


def test_the_projector_shows_the_picture_until_interrupted(given, tmp_path, monkeypatch, capsys):
    """Pixel by pixel, on its own display alone; dark afterwards."""
    seen = []

    def look(_):
        seen.append([screenshot(f"{desktop}.{index}") for index in range(2)])
        if len(seen) == 2:
            raise KeyboardInterrupt

    with x_server("640x480x24", "1280x800x24") as desktop:
        monkeypatch.setenv("DISPLAY", desktop)
        monkeypatch.setattr(project, "time", SimpleNamespace(perf_counter=time.perf_counter, sleep=look))
        shown = ["show=true", "devices=basler", "devices.projector.delay_s=0"]
        assert main(["project", *given, f"masses={tmp_path}/masses", *shown]) == 130
        assert not screenshot(f"{desktop}.1").any()
    picture = cv2.imread(str(tmp_path / "out" / "projector.png"), cv2.IMREAD_UNCHANGED)
    for beside, projector in seen:
        assert not beside.any() and (projector == picture[..., None]).all()
    assert "until Ctrl-C" in capsys.readouterr().out


@pytest.mark.parametrize(("fields", "complaint"), [
    ("devices=basler", "DISPLAY: log in at the computer that the projector is connected to"),
    ("", "show: expected a projector, found no devices; give devices=basler"),
    ("devices=basler devices.projector=null", "show: expected a projector, found none among the devices"),
    ("devices=basler devices.projector.size=[1024,768]", "optics.yaml: expected projector of 1024x768 px, found 1280x800"),
])  # fmt: skip
def test_a_picture_without_a_display_is_one_line(given, tmp_path, monkeypatch, capsys, fields, complaint):
    monkeypatch.delenv("DISPLAY", raising=False)
    assert main(["project", *given, f"masses={tmp_path}/masses", "show=true", *fields.split()]) == 2
    said = capsys.readouterr().err
    assert complaint in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("fields", "complaint"), [
    ("", "project: expected masses, a cut or a capture to draw, found none of them"),
    ("masses=nowhere", "nowhere: expected a folder of `sonotwin segment`"),
    ("masses=HERE/masses calibration=none.yaml", "none.yaml: expected"),
    ("masses=HERE/masses skin=none.ply", "none.ply: expected"),
    ("masses=HERE/masses lines.mass.width_mm=0", "lines.mass.width_mm: expected"),
    ("masses=HERE/masses eye_mm=[1,2]", "eye_mm"),
    ("masses=HERE/masses eye_mm=[0,0,1000]", "eye_mm: expected a place before the skin, found [0.0, 0.0, 1000.0] behind it"),
    ("masses=HERE/none", "none: expected masses to draw, found none in it"),
    ("cut=HERE/skin.ply", "skin.ply: expected"),
    ("masses=HERE/masses earlier_skin=HERE/far.ply", "expected the earlier skin, moved by up to 15 mm, found"),
    ("masses=HERE/far", "mass0: expected skin over it, found none"),
])  # fmt: skip
def test_bad_input_is_one_line(given, tmp_path, capsys, fields, complaint):
    meshes.write_ply(tmp_path / "far.ply", bent(rigid.from_rotation_vector([0, 0, 0], [0, 0, 60.0])))
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / "metrics.json").write_text("{}")
    (tmp_path / "far").mkdir()
    meshes.write_ply(tmp_path / "far" / "mass0.ply", trimesh.creation.icosphere(2, 8.0).apply_translation([300.0, 0, 700]))
    assert main(["project", *given, *fields.replace("HERE", str(tmp_path)).split()]) == 2
    said = capsys.readouterr().err
    assert complaint in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()
