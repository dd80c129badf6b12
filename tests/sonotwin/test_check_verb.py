"""`sonotwin check`: a capture's parts, verdicts and exit status; the whole way over rendered images is a slow test of its own."""

import json
import shutil
from dataclasses import replace
from datetime import date

import numpy as np
import pytest

from recon.capture import calibration_files, lag_files, probe_files
from recon.capture.lag_files import LagFile
from recon.geometry import rigid
from recon.identification import rig_file
from recon.identification.estimates import Estimate, Findings
from recon.model.calibration import Calibration, Uncertainty
from recon.model.probe import ProbeCalibration
from recon.probe_calibration.sound_in_water import speed_of_sound
from scenes.board_poses import Config as Poses
from sonotwin.cli import main
from tests.recon import bscans, sweep_sets
from tests.recon.tracking import films
from tests.twin.parting import parted_mm
from tests.twin.small_rigs import half, half_as_fields
from twin.conditions import IDEAL
from twin.experiments.drawn_session import Noise, calibrated_optics
from twin.optics.surface_session import calibration_of

LAG_S = 0.0473


@pytest.fixture(scope="module")
def bottom(tmp_path_factory):
    """A capture of B-scans of a bottom with poses, and files of the lag that is known, and of a probe."""
    folder = tmp_path_factory.mktemp("check")
    sweep_sets.bottom(folder / "capture", np.random.default_rng(0), LAG_S)
    for name, lag in (("lag", LAG_S), ("early", LAG_S - 0.02)):
        measured = LagFile(lag_s=lag, sigma_s=0.001, interval_s=(lag - 0.002, lag + 0.002), coverage=0.95)
        lag_files.write(folder / f"{name}.json", measured)
    return folder


def test_a_capture_without_any_part_is_refused(tmp_path, capsys):
    (tmp_path / "manifest.json").write_text(json.dumps({"schema": "sonotwin-capture/1", "devices": {}}))
    assert main(["check", f"capture={tmp_path}", f"out={tmp_path / 'out'}"]) == 2
    error = capsys.readouterr().err
    assert "expected frames of the target, fringes before both cameras, or tracked B-scans" in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_sweep_that_is_not_there_is_named(bottom, tmp_path, capsys):
    assert main(["check", f"capture={bottom / 'capture'}", f"out={tmp_path / 'out'}", "film=other"]) == 2
    assert "film: expected one of its sweeps, found other" in capsys.readouterr().err


def test_a_damaged_log_is_refused_before_any_work(bottom, tmp_path, capsys):
    (tmp_path / "rig.jsonl").write_text("no check\n")
    assert main(["check", f"capture={bottom / 'capture'}", f"out={tmp_path / 'out'}", f"log={tmp_path / 'rig.jsonl'}"]) == 2
    assert "rig.jsonl" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_a_log_within_the_folder_that_is_replaced_is_refused(bottom, tmp_path, capsys):
    log = tmp_path / "out" / "rig.jsonl"
    assert main(["check", f"capture={bottom / 'capture'}", f"out={tmp_path / 'out'}", f"log={log}"]) == 2
    assert "expected a folder apart from what is read" in capsys.readouterr().err and not (tmp_path / "out").exists()


def write_probe(path):
    """A probe that looks down, known to 1 mrad and 0.05 mm."""
    names = ("rx", "ry", "rz", "tx", "ty", "tz")
    sigma = Uncertainty(names, np.diag(np.repeat([1e-3, 0.05], 3) ** 2))
    looking_down = rigid.transform([[1, 0, 0], [0, 0, -1], [0, 1, 0]], [0, 0, 0])
    probe_files.write(path, ProbeCalibration(looking_down, np.full(2, bscans.MM_PER_PX), sigma, float(speed_of_sound(22.0))))


@pytest.mark.parametrize(("lag", "status"), [("lag", 0), ("early", 1)])
def test_a_clock_that_is_off_is_told_and_logged(bottom, tmp_path, capsys, lag, status):
    """By 20 ms, known to 1 ms. Straight up and down, the bracket stays open; what wasn't recorded is not checked."""
    write_probe(tmp_path / "probe.yaml")
    files = [f"probe={tmp_path / 'probe.yaml'}", f"lag={bottom / f'{lag}.json'}", f"log={tmp_path / 'rig.jsonl'}"]
    assert main(["check", f"capture={bottom / 'capture'}", f"out={tmp_path / 'out'}", *files]) == status
    made = json.loads((tmp_path / "out/check.json").read_text())
    states = {one["part"]: one["state"] for one in made["parts"]}
    assert states["clock"] == ("moved" if status else "good") and states["cam1"] == "unseen"
    assert states["probe"] in ("open", "good")
    assert len((tmp_path / "rig.jsonl").read_text().splitlines()) == 1
    assert made["parts"][5]["estimate"]["motion"][0] == pytest.approx(0.02 if status else 0.0, abs=3e-3)
    page, said = (tmp_path / "out/check.html").read_text(encoding="utf-8"), capsys.readouterr().out
    assert ("Run measure-lag." in page) == bool(status) == ("Moved: scanner's clock. Run measure-lag." in said)


def test_a_clock_that_drifts_below_the_alarm_ends_with_status_1(bottom, tmp_path, capsys):
    """Earlier checks found it 9 ms early, of a lag known to 5 ms and checks good to 1 ms."""
    write_probe(tmp_path / "probe.yaml")
    log = tmp_path / "rig.jsonl"
    files = [f"probe={tmp_path / 'probe.yaml'}", f"lag={bottom / 'lag.json'}", f"log={log}"]
    line = ["check", f"capture={bottom / 'capture'}", f"out={tmp_path / 'out'}", *files]
    assert main(line) == 0 and "Out of control" not in capsys.readouterr().out
    made = json.loads(log.read_text())
    clock = made["parts"][5]["estimate"]
    clock |= {"motion": [clock["motion"][0] - 9e-3], "own": [[1e-6]], "common": [[2.5e-5]]}
    for day in range(2):
        clock["motion"] = [clock["motion"][0] + 2e-6]
        made["time"] = f"2026-05-0{day + 1}T08:00:00Z"
        log.write_text(("" if day == 0 else log.read_text()) + json.dumps(made) + "\n")
    assert main(line) == 1
    assert "Out of control over the days: scanner's clock since 2026-05-02" in capsys.readouterr().out


def test_poses_of_the_bottom_may_be_in_track_s_folder(bottom, tmp_path, capsys):
    """The capture has its B-scans without poses; what it lacks is said with the way on."""
    shutil.copytree(bottom / "capture", tmp_path / "capture")
    listed = json.loads((tmp_path / "capture/manifest.json").read_text())
    del listed["sweep"]["track"]
    (tmp_path / "capture/manifest.json").write_text(json.dumps(listed))
    line = ["check", f"capture={tmp_path / 'capture'}", f"out={tmp_path / 'out'}"]
    assert main(line) == 2 and "whose folder is tracked" in capsys.readouterr().err
    probe = ProbeCalibration(rigid.transform([[1, 0, 0], [0, 0, -1], [0, 1, 0]], [0, 0, 0]), np.full(2, bscans.MM_PER_PX))
    probe_files.write(tmp_path / "probe.yaml", probe)
    files = [f"tracked={bottom / 'capture'}", f"probe={tmp_path / 'probe.yaml'}", f"lag={bottom / 'lag.json'}"]
    main([*line, *files])
    assert "film=NAME" in (said := capsys.readouterr().out) and "bottom      in" in said


def test_a_film_by_another_rig_s_calibration_is_not_called_dirty_only(rig, tmp_path, capsys):
    """Camera 2 is turned by 3 deg: no pose fits both views. A file that isn't there is named, whatever is checked."""
    films.film(tmp_path / "film", rig, np.random.default_rng(4), count=6)
    cameras = calibration_of(rig).cameras
    turn = rigid.from_rotation_vector(np.deg2rad([0, 3, 0]), np.zeros(3))
    other = {**cameras, "cam2": replace(cameras["cam2"], camera_from_world=turn @ cameras["cam2"].camera_from_world)}
    calibration_files.write(tmp_path / "other.yaml", Calibration({name: other[name] for name in ("cam1", "cam2")}))
    line = ["check", f"capture={tmp_path / 'film'}", f"out={tmp_path / 'out'}"]
    assert main([*line, f"calibration={tmp_path / 'other.yaml'}"]) == 2
    assert "or is the calibration another rig's" in capsys.readouterr().err
    assert main([*line, f"lag={tmp_path / 'none.json'}"]) == 2
    assert "none.json: expected a file, found none" in capsys.readouterr().err and not (tmp_path / "out").exists()


def write_rig(path, rig, version, **off):
    """A rig's file of two measured numbers, some off by so much."""
    sigmas = {"cam1.lens.focus_mm": 1.0, "projector.gamma": 0.01}
    found = {name: Estimate(rig.number(name) + off.get(name, 0.0), sigma, "a test") for name, sigma in sigmas.items()}
    known = rig_file.next_version(rig_file.apply(rig, Findings(found)), f"day {version}", date(2026, 5, version))
    path.parent.mkdir(exist_ok=True)
    rig_file.write(path, known.model_copy(update={"version": version}), {}, "a test")


@pytest.mark.parametrize(("focus_mm", "status"), [(0.5, 0), (12.0, 1)])
def test_a_rig_s_numbers_are_compared_with_its_file_and_logged(rig, tmp_path, capsys, focus_mm, status):
    """Without a capture of the parts; the folder of identify and its file are the same."""
    write_rig(tmp_path / "rig.yaml", rig, 3)
    write_rig(tmp_path / "today/rig.yaml", rig, 4, **{"cam1.lens.focus_mm": focus_mm, "projector.gamma": 0.001})
    for today in ("today", "today/rig.yaml"):
        line = [f"rig={tmp_path / 'rig.yaml'}", f"today={tmp_path / today}", f"log={tmp_path / 'log.jsonl'}"]
        assert main(["check", *line, f"out={tmp_path / 'out'}"]) == status
    said, page = capsys.readouterr().out, (tmp_path / "out/check.html").read_text(encoding="utf-8")
    assert "version 4 (2026-05-04, day 4) against version 3 (2026-05-03, day 3): 2 numbers, limit 2.9" in said
    assert ("Changed: camera 1's lens: focus. If" in said) == ("Changed: camera 1" in page) == bool(status)
    told = f"lens: focus +12 ± 1.4 mm, from {rig.cam1.lens.focus_mm:g} mm, 8.5 σ"
    assert (told in said) == bool(status)
    assert "Numbers of the rig" in page and page.count("<svg") == 1
    logged = [json.loads(each)["rig"] for each in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [one["numbers"][0]["changed"] for one in logged] == 2 * [bool(status)]


def test_rigs_that_say_nothing_of_each_other_are_refused(rig, tmp_path, capsys):
    """In one line, with nothing written."""
    write_rig(tmp_path / "rig.yaml", rig, 3)
    ours = f"rig={tmp_path / 'rig.yaml'}"
    for given, told in (
        ([], "capture: expected a capture folder, or today="),
        ([f"today={tmp_path / 'rig.yaml'}"], "rig: expected a rig's file that sonotwin identify wrote"),
        ([ours, f"today={tmp_path / 'none'}"], "none: expected a rig's file, found none"),
        ([ours, f"today={tmp_path}"], "found 2 that are the same"),
    ):
        assert main(["check", *given, f"out={tmp_path / 'out'}"]) == 2
        said = capsys.readouterr().err
        assert told in said and said.count("\n") == 1 and not (tmp_path / "out").exists()


SEED = 21  # of calibration, drift, prints, hand and light: nothing was tried on it
LIFE = ["conditions=lifelike", f"seed={SEED}"]
RENDERED = ["cameras=[cam1,cam2]", "scene=breast", "patterns=paper_calibration", "tracing.samples=4", *LIFE]


@pytest.fixture(scope="module")
def drifted(rig, tmp_path_factory):
    """A folder with a calibration that errs as it says, and a film of the target by cameras that have drifted since.

    Cameras have half the size.
    """
    folder = tmp_path_factory.mktemp("drifted")
    calibration_files.write(folder / "optics.yaml", calibrated_optics(half(rig), IDEAL, Noise(), Poses(count=16), SEED))
    assert main(["film", f"out={folder}", "frames=16", "path.turn_deg=20", "white_dn=120", *LIFE, *half_as_fields(rig)]) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("shift_mm", [0.0, 0.3])
def test_a_rendered_rig_is_as_calibrated_but_for_a_projector_that_was_shifted(rig, drifted, tmp_path, shift_mm):
    """Skin that light spreads in, a lamp that flickers, drift of a warm day: no alarm. A shift by 0.3 mm is 0.8 px."""
    x, y, z = rig.projector.optics.device_from_world.translation_mm
    moved = f"rig.projector.optics.device_from_world.translation_mm=[{x + shift_mm},{y + shift_mm},{z}]"
    shutil.copytree(drifted / "capture", tmp_path / "capture")
    assert main(["render", f"out={tmp_path}", "add=true", *half_as_fields(rig), moved, *RENDERED]) == 0
    line = ["check", f"capture={tmp_path / 'capture'}", f"calibration={drifted / 'optics.yaml'}", f"out={tmp_path / 'check'}"]
    assert main(line) == (1 if shift_mm else 0)
    states = {one["part"]: one["state"] for one in json.loads((tmp_path / "check/check.json").read_text())["parts"]}
    assert [part for part in ("cam1", "cam2", "projector", "target") if states[part] == "moved"] == ["projector"] * bool(shift_mm)
    corrected = tmp_path / "check/optics.yaml"
    assert corrected.is_file() != bool(shift_mm)  # what was moved is calibrated anew
    if not shift_mm:
        assert parted_mm(corrected, tmp_path / "truth") < 0.015 < parted_mm(drifted / "optics.yaml", tmp_path / "truth")
