"""`sonotwin calibrate-target`, from a drawn film of a target that isn't as designed to its file, and to poses with that."""

import json
from pathlib import Path

import numpy as np
import pytest

import sonotwin
from recon.capture import target_files
from recon.geometry import rigid
from recon.model import circle_layout
from recon.tracking import networks
from sonotwin.cli import main
from tests.recon import captures
from tests.recon.tracking import drawings, films
from tests.recon.tracking.stand_ins import Told

COUNT = 9
ACTUAL = {"c1_mm": 25.12, "c2_aside_mm": -0.16, "c2_mm": 39.9, "outer_diameter_mm": 18.04}


@pytest.fixture(scope="module")
def poses():
    """Near enough from one to the next, so that the tracker follows."""
    rng = np.random.default_rng(11)
    first = drawings.facing(rng, 5.0)
    turns = np.radians(8.0) * np.array([[np.sin(a), np.cos(a), 0.3] for a in np.linspace(0, 2 * np.pi, COUNT)])
    away = [np.array([2.0 * k, 0.0, 4.0 * k]) for k in range(COUNT)]
    return [films.moved(first, turn, shift) for turn, shift in zip(turns, away, strict=True)]


@pytest.fixture(scope="module")
def drawn(rig, poses, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("turned") / "capture"
    actual = rig.model_copy(update={"target": rig.target.model_copy(update=ACTUAL)})
    pairs = films.draw(actual, poses, np.random.default_rng(4))
    captures.write_film(folder, pairs, films.stamps(COUNT), films.optics(rig), films.devices(rig), "turned")
    return folder


@pytest.fixture
def told(rig, poses, monkeypatch) -> Told:
    stand_in = Told(films.centres(rig, poses[0]))
    monkeypatch.setattr(networks, "load", lambda *_: stand_in)
    return stand_in


def test_the_target_is_measured_and_poses_are_exact_with_it(drawn, poses, told, rig, tmp_path, capsys):
    out = tmp_path / "target"
    assert main(["calibrate-target", f"capture={drawn}", f"out={out}"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["found", "adjust", "c1", "c2", "c2", "rims", "bow", "warning", "wrote"]
    assert lines[0] == "found       9 of 9 pairs whole, 9 poses that differ"
    assert "has no covariance" in lines[-2]
    found = target_files.read(out / "target.yaml", rig.target)
    off = circle_layout.lengths(found) - [ACTUAL[name] for name in rig.target.LENGTHS]
    assert np.abs(off).max() < 0.005 and abs(found.outer_diameter_mm - 18.04) < 0.01
    assert np.all(np.abs(off) < 4 * np.sqrt(np.diag(found.covariance_mm2)))
    assert json.loads((out / "metrics.json").read_text())["pairs_used"] == 9

    errors = {}
    for name, fields in (("designed", []), ("measured", [f"target={out / 'target.yaml'}"])):
        assert main(["track", f"capture={drawn}", f"out={tmp_path / name}", "overlays=false", *fields]) == 0
        text = capsys.readouterr().out
        assert "found       9 of 9 frames" in text and ("off its design" in text) == (name == "designed")
        figures = json.loads((tmp_path / name / "metrics.json").read_text())
        errors[name] = figures["sigma_median_deg"]
    assert errors["measured"] < 0.7 * errors["designed"]


def test_the_interface_gives_the_verbs_figures(drawn, told, rig, tmp_path):
    assert main(["calibrate-target", f"capture={drawn}", "most_poses=8", f"out={tmp_path / 'out'}"]) == 0
    film = sonotwin.read_film(drawn)
    tracker = sonotwin.Tracker(film.cameras, rig.target, told, film.bits, film.optics)
    pairs = zip(film.times.tolist(), film.pairs(), strict=True)
    tracked = (tracker.step(*pair, 1e-9 * time) for time, pair in pairs)
    found = sonotwin.calibrate_target(tracked, film.cameras, rig.target, tracker.optics_in_use, most_poses=8)
    figures = json.loads((tmp_path / "out" / "metrics.json").read_text())
    sigmas = np.sqrt(np.diag(found.covariance))
    for name, sigma in zip(target_files.lengths_and_diameter(rig.target), sigmas, strict=False):
        assert figures[name] == pytest.approx(getattr(found.target, name), rel=1e-9)
        assert figures[f"sigma_{name}"] == pytest.approx(sigma, rel=1e-9)
    assert figures["pairs_used"] == found.used.sum() == len(found.pairs) == 8 and len(found.collected.seen) == COUNT


@pytest.mark.parametrize("verb", ["calibrate-target", "check"])
def test_a_second_target_of_the_design_is_named(verb, drawn, rig, poses, told, tmp_path, capsys):
    """In the first pairs both cameras see another one 110 mm beside that which the network finds first."""
    actual, rng = rig.target.model_copy(update=ACTUAL), np.random.default_rng(4)
    cameras, away = films.optics(rig).cameras.values(), rigid.transform(np.eye(3), [110.0, 5, 10])
    pairs = list(sonotwin.read_film(drawn).pairs())
    for k, pose in enumerate(poses[:2]):
        one, other = ([drawings.frame(camera, [at], actual, 65.0) for camera in cameras] for at in (pose, away @ pose))
        both = [np.where(np.abs(b - b[0, 0]) > 0.5, b, a) for a, b in zip(one, other, strict=True)]
        pairs[k] = tuple(drawings.read_out(view - drawings.BLACK_DN, rng) for view in both)
    told.names = (0, 1, 2, 0, 1, 2)
    beside = films.centres(rig, away @ poses[0])
    told.places = [np.vstack(each) for each in zip(told.places, beside, strict=True)]
    capture, out = tmp_path / "two", tmp_path / "out"
    captures.write_film(capture, pairs, films.stamps(COUNT), films.optics(rig), films.devices(rig), "two")
    assert main([verb, f"capture={capture}", f"out={out}"]) in (0, 1)
    said = capsys.readouterr().out
    assert "warning     a second target of this design in 1 of 1 pairs searched for one, first in pair 1, 111 mm" in said


def test_a_film_in_uneven_light_will_do_if_there_is_no_other(rig, poses, told, tmp_path, capsys):
    """Stripes of 12 % across all rims, as of a window blind: less exact, and so by what is predicted."""
    columns = np.arange(rig.cam1.optics.size[0])
    light = 1 + 0.12 * np.sin(2 * np.pi * columns / 150)
    actual = rig.target.model_copy(update=ACTUAL)
    cameras, rng = [getattr(rig, name).optics.camera() for name in ("cam1", "cam2")], np.random.default_rng(4)
    pairs = (tuple(drawings.frame(camera, [pose], actual, 65.0, rng, light=light) for camera in cameras) for pose in poses)
    captures.write_film(tmp_path / "dim", pairs, films.stamps(COUNT), films.optics(rig), films.devices(rig), "dim")
    assert main(["calibrate-target", f"capture={tmp_path / 'dim'}", f"out={tmp_path / 'target'}"]) == 0
    assert "9 poses that differ, 9 of them in uneven light: less exact" in capsys.readouterr().out
    found = target_files.read(tmp_path / "target" / "target.yaml", rig.target)
    off = circle_layout.lengths(found) - [ACTUAL[name] for name in rig.target.LENGTHS]
    assert np.all(np.abs(off) < 4 * np.sqrt(np.diag(found.covariance_mm2))) and np.abs(off).max() < 0.05


def test_what_is_wrong_is_said_in_one_line(drawn, told, tmp_path, capsys):
    def complaint(*fields: str) -> str:
        assert main(["calibrate-target", f"capture={drawn}", f"out={tmp_path / 'out'}", *fields]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line.removeprefix("sonotwin: ")

    assert complaint("least_tilt_deg=30").startswith(
        "turned: expected tilts that differ by 30 deg (standard deviation; to all sides)"
    )
    assert "distances over 500 mm, found 3" in complaint("least_range_mm=500")
    assert complaint("most_poses=3").startswith("calibrate-target: most_poses: expected")
    assert complaint(f"capture={tmp_path}") == f"{tmp_path}/manifest.json: expected a file, found none"
    assert "expected a folder apart from what is read" in complaint(f"out={drawn}")
    assert "rig.target.covariance_mm2" in complaint("rig.target.covariance_mm2=[[1,0,0],[0,-1,0],[0,0,1]]")
    assert not (tmp_path / "out").exists()


def test_a_film_too_short_is_refused(rig, told, tmp_path, capsys):
    capture = films.film(tmp_path / "capture", rig, np.random.default_rng(4), count=2)
    assert main(["calibrate-target", f"capture={capture}", f"out={tmp_path / 'out'}"]) == 2
    assert "expected 8 different poses, by 2 mm or 1 deg, in which both cameras see all" in capsys.readouterr().err
