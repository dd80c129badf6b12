"""`sonotwin mentor`, from a drawn recording to light, with a mentor who asks by HTTP."""

import json
import re
import threading
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
import yaml

from recon.capture import calibration_files, sweep_tables
from recon.errors import InputError
from recon.files import meshes
from recon.geometry import rigid
from recon.model.tracks import Track
from sonotwin import config
from sonotwin.cli import main
from sonotwin.verbs import mentor
from tests.patience import PATIENCE_S
from tests.recon.navigation.live_stand_ins import until
from tests.recon.skin_projection import skin_shapes
from tests.recon.tracking import films
from tests.recon.web_visitors import answer
from twin.optics.surface_session import calibration_of


@pytest.fixture
def given(rig, tmp_path):
    """A recording of a target that moves evenly, a skin, and a calibration of all devices."""
    films.film(tmp_path / "capture", rig, np.random.default_rng(4))
    meshes.write_ply(tmp_path / "skin.ply", skin_shapes.plane(step=2.0))
    calibration_files.write(tmp_path / "optics.yaml", calibration_of(rig))
    paths = {"capture": "capture", "skin": "skin.ply", "calibration": "optics.yaml", "out": "out"}
    return [*(f"{key}={tmp_path / name}" for key, name in paths.items()), "part_table=false", "view.port=0"]


@pytest.fixture
def patient(rig, tmp_path):
    """A rig whose patient carries the target that is drawn."""
    own = yaml.safe_load(yaml.safe_dump(rig.target.model_dump(mode="json", exclude_none=True)))
    other = own | {"c1_mm": 28.0, "c2_mm": 24.0, "board_mm": [63.0, 49.0]}
    content = {"defaults": ["meza2021"], "target": other, "bodies": {"patient": own}}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    return f"rig={tmp_path / 'rig.yaml'}"


class Run:
    """The command in a thread; its pages are asked for meanwhile."""

    def __init__(self, fields, capsys, monkeypatch):
        self.ended, self._capsys, self._text, self.status = threading.Event(), capsys, "", None
        monkeypatch.setattr(mentor, "monotonic", lambda: float(self.ended.is_set()) * 2e6)
        self._thread = threading.Thread(target=self._run, args=(fields,))
        self._thread.start()

    def _run(self, fields):
        self.status = mentor.run(config.load("mentor", [*fields, "seconds=1e6"], mentor.Config))

    @property
    def said(self):
        self._text += self._capsys.readouterr().out
        return self._text

    def address(self):
        """Of the first mentor."""
        until(lambda: "view " in self.said or not self._thread.is_alive())
        return urlsplit(re.search(r"view +\S+: (\S+)", self.said)[1])

    def ask(self, path, posted=None):
        place = self.address()
        content = None if posted is None else json.dumps(posted).encode()
        kind = {} if posted is None else {"Content-Type": "application/json"}
        return answer(f"{place.scheme}://{place.netloc}", place.path + path, content, **kind)

    def state(self):
        return json.loads(self.ask("state")[1])

    def end(self):
        until(lambda: "\nlight " in self.said or not self._thread.is_alive())  # else it might begin to count after the end
        self.ended.set()
        self._thread.join(PATIENCE_S)
        return self.status


def draw(run):
    """Draw on the newest picture."""
    until(lambda: run.ask("picture.jpg")[0] == 200)
    stroke = {"kind": "stroke", "picture": run.state()["picture"], "places": [[600, 500], [680, 540]]}
    until(lambda: run.ask("picture.jpg")[0] == 200 and run.ask("draw", stroke | {"picture": run.state()["picture"]})[0] == 200)


@pytest.mark.slow
def test_what_is_drawn_is_lit_and_restored(given, rig, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(mentor, "WRITE_S", -1.0)
    run = Run(given, capsys, monkeypatch)
    draw(run)
    assert run.state()["light"] == "lit where the skin was measured"

    def lit():
        picture = cv2.imread(str(tmp_path / "out" / "lit.png"), cv2.IMREAD_UNCHANGED)
        return picture is not None and bool(picture.any())

    until(lit)
    picture = cv2.imread(str(tmp_path / "out" / "lit.png"), cv2.IMREAD_UNCHANGED)
    ray = rig.cam1.optics.camera().rays([640.0, 520.0])
    u, v = np.rint(rig.projector.optics.camera().project(ray * skin_shapes.PLANE_MM / ray[2])).astype(int)
    assert picture.shape == (800, 1280) and picture[v - 1 : v + 2, u - 1 : u + 2].max() > 200
    assert run.end() == 0 and "ms of a core each" in run.said
    run.ended.clear()
    again = Run(given, capsys, monkeypatch)
    assert len(again.state()["drawings"]) == 1 and "restored    1 drawings" in again.said
    assert again.end() == 0


@pytest.mark.slow
def test_light_follows_the_patient_from_the_reference(given, rig, patient, tmp_path, capsys, monkeypatch):
    """The target is the one of the film; the skin was measured when it stood 5 mm beside its first place."""
    at = rigid.transform(np.eye(3), [5.0, 0, 0]) @ films.places(1)
    sweep_tables.write_track(tmp_path / "reference.csv", Track(np.array([5]), at))
    shown = []
    monkeypatch.setattr(mentor.PictureFile, "show", lambda self, pattern: shown.append(pattern))
    run = Run([*given, patient, f"reference={tmp_path / 'reference.csv'}", "hold_s=1"], capsys, monkeypatch)
    draw(run)
    until(lambda: any(pattern.any() for pattern in shown[-5:]))
    assert run.end() == 0
    entry = next(line for line in map(json.loads, (tmp_path / "out" / "log.jsonl").open()) if line["event"] == "drawn")
    ray = rig.cam1.optics.camera().rays([600.0, 500.0])
    steps = films.places(4)[:, :3, 3] - at[0, :3, 3]
    met = (skin_shapes.PLANE_MM + steps[:, 2:]) * ray / ray[2]
    off = np.linalg.norm(np.array(entry["points"][0]) - (met - steps), axis=1)
    assert off.min() < 0.1, (
        "where the moved skin was met, moved back by where the patient had gone at one of the film's four moments"
    )
    assert not shown[-1].any(), "dark at the end"


@pytest.mark.parametrize(("fields", "complaint"), [
    ("skin=none.ply", "none.ply: expected"),
    ("calibration=none.yaml", "none.yaml: expected"),
    ("calibration=null", "expected the projector, too, found cam1, cam2; give calibration=FILE of the whole rig"),
    ("masses=HERE", "expected a folder of `sonotwin segment`"),
    ("hold_s=2", "mentor: hold_s: expected"),
    ("mentors=[]", "mentor: mentors: expected"),
    ("mentors=['a b']", "mentor: mentors"),
    ("capture=null", "mentor: capture: expected it or devices, found neither"),
    ("rig=three_bodies", "mentor: reference: expected the pose of the patient when the skin was measured, found none; give"),
    ("rig=three_bodies reference=none.csv", "none.csv: expected"),
    ("view.host=192.0.2.1", "view: expected 192.0.2.1:0 to be free, found"),
    ("devices=basler capture=null devices.projector=null", "devices.projector: expected one, which lights what is drawn"),
])  # fmt: skip
def test_bad_input_is_one_line(given, tmp_path, capsys, fields, complaint):
    assert main(["mentor", *given, *fields.replace("HERE", str(tmp_path)).split()]) == 2
    said = capsys.readouterr().err
    assert complaint in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_log_of_another_skin_and_a_file_of_somebody_else_are_left_alone(given, tmp_path, capsys):
    assert main(["mentor", *given, "seconds=0.1"]) == 0
    meshes.write_ply(tmp_path / "skin.ply", skin_shapes.plane(step=2.5))
    assert main(["mentor", *given, "seconds=0.1"]) == 2
    assert "found one of another skin: give another out, or that skin" in capsys.readouterr().err
    (tmp_path / "out" / "log.jsonl").write_text("mine\n", encoding="utf-8")
    assert main(["mentor", *given, "seconds=0.1"]) == 2
    assert "log.jsonl: expected nothing or a file as mentor wrote it" in capsys.readouterr().err


def test_devices_of_a_laboratory_are_taken_and_stand_ins_are_not(given):
    others = [field for field in given if not field.startswith("capture=")]
    assert config.load("mentor", [*others, "devices=basler"], mentor.Config).devices
    with pytest.raises(InputError, match="mentor: devices: expected those of a laboratory"):
        config.load("mentor", [*others, "devices=virtual"], mentor.Config)
