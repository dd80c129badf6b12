"""`sonotwin track`, from a drawn film to poses, with stand-ins for the networks."""

import json
from pathlib import Path

import numpy as np
import pytest

from recon.capture import sweep_tables
from recon.tracking import networks
from sonotwin.cli import main
from tests.recon import captures
from tests.recon.tracking import films
from tests.recon.tracking.stand_ins import Told


@pytest.fixture(scope="module")
def drawn(rig, tmp_path_factory) -> Path:
    return films.film(tmp_path_factory.mktemp("film") / "capture", rig, np.random.default_rng(4), count=3, missing=(2,))


@pytest.fixture
def told(rig, monkeypatch) -> Told:
    stand_in = Told(films.centres(rig, films.places(1)[0]))
    monkeypatch.setattr(networks, "load", lambda *_: stand_in)
    return stand_in


def test_a_film_is_tracked_and_told(drawn, told, tmp_path, capsys):
    out = tmp_path / "track"
    assert main(["track", f"capture={drawn}", f"out={out}"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["read", "found", "lost", "speed", "sigma", "wrote"]
    assert lines[0] == "read        3 pairs of frames, 1280x1024, 30 a second"
    assert lines[1] == "found       2 of 3 frames, 1 not: only camera 1 sees the target (1)"
    assert lines[5] == f"wrote       {out}/{{frames.csv,metrics.json,overlays/,poses.csv}}"
    track = sweep_tables.read_track(out / "poses.csv")
    assert np.linalg.norm(track.poses[:2, :3, 3] - films.places(2)[:, :3, 3], axis=1).max() < 0.05
    figures = json.loads((out / "metrics.json").read_text())
    assert (figures["frames"], figures["frames_found"], figures["frames_detected"]) == (3, 2, 1)
    assert [path.name for path in sorted((out / "overlays").iterdir())] == ["0000.jpg", "0001.jpg", "0002.jpg"]


def test_pictures_can_be_left_out_and_results_replaced(drawn, told, tmp_path):
    out = tmp_path / "track"
    for _ in range(2):
        assert main(["track", f"capture={drawn}", f"out={out}", "overlays=false"]) == 0
    assert not (out / "overlays").exists()


def test_what_is_wrong_is_said_in_one_line(drawn, tmp_path, capsys):
    def complaint(*fields: str) -> str:
        assert main(["track", f"capture={drawn}", f"out={tmp_path / 'out'}", *fields]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line.removeprefix("sonotwin: ")

    assert complaint(f"networks={tmp_path}") == f"{tmp_path}/detector.onnx: expected a network, found none"
    assert complaint(f"capture={tmp_path}") == f"{tmp_path}/manifest.json: expected a file, found none"
    assert complaint(f"calibration={tmp_path / 'none.yaml'}").startswith(f"{tmp_path}/none.yaml: expected a calibration file")
    assert complaint("threads=-1").startswith("track: threads: expected")
    assert "expected a folder apart from what is read" in complaint(f"out={drawn}")
    assert not (tmp_path / "out").exists()


def test_a_damaged_frame_leaves_nothing_behind(rig, told, tmp_path, capsys):
    capture = films.blank(tmp_path / "capture", rig)
    path = capture / "sweep/cam2/0002.png"
    path.write_bytes(path.read_bytes()[:-30])
    assert main(["track", f"capture={capture}", f"out={tmp_path / 'out'}"]) == 2
    assert capsys.readouterr().err.startswith(f"sonotwin: {path}: expected a whole PNG image")
    assert [entry.name for entry in tmp_path.iterdir()] == ["capture"]


def test_exchanged_cameras_are_named_and_no_pose_is_a_failure(rig, monkeypatch, tmp_path, capsys):
    """The frames of one camera in the other's folder: nothing is found, and that isn't passed over."""
    pairs = ((right, left) for left, right in films.draw(rig, films.places(2), np.random.default_rng(4)))
    captures.write_film(tmp_path / "crossed", pairs, films.stamps(2), films.optics(rig), films.devices(rig), "crossed")
    monkeypatch.setattr(networks, "load", lambda *_: Told(films.centres(rig, films.places(1)[0])[::-1]))
    assert main(["track", f"capture={tmp_path / 'crossed'}", f"out={tmp_path / 'out'}", "overlays=false"]) == 1
    told = capsys.readouterr()
    assert "found       0 of 2 frames, 2 not: cameras exchanged (2)" in told.out
    assert "warning     cameras exchanged? In 2 of 2 pairs" in told.out
    assert told.err == "sonotwin: crossed: no pose in 2 pairs: cameras exchanged (2); see frames.csv\n"
    assert (tmp_path / "out" / "frames.csv").exists()
