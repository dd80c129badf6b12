"""`sonotwin check`: a capture's parts, verdicts and exit status; the whole way over rendered images is a slow test of its own."""

import json

import numpy as np
import pytest

from recon.capture import lag_files, probe_files
from recon.capture.lag_files import LagFile
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import ProbeCalibration
from recon.probe_calibration.sound_in_water import speed_of_sound
from sonotwin.cli import main
from tests.recon import bscans, sweep_sets

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


@pytest.mark.parametrize(("lag", "status"), [("lag", 0), ("early", 1)])
def test_a_clock_that_is_off_is_told_and_logged(bottom, tmp_path, capsys, lag, status):
    """By 20 ms, known to 1 ms. Straight up and down, the bracket stays open; what wasn't recorded is not checked."""
    names = ("rx", "ry", "rz", "tx", "ty", "tz")
    sigma = Uncertainty(names, np.diag(np.repeat([1e-3, 0.05], 3) ** 2))
    looking_down = rigid.transform([[1, 0, 0], [0, 0, -1], [0, 1, 0]], [0, 0, 0])
    water = float(speed_of_sound(22.0))
    probe_files.write(tmp_path / "probe.yaml", ProbeCalibration(looking_down, np.full(2, bscans.MM_PER_PX), sigma, water))
    files = [f"probe={tmp_path / 'probe.yaml'}", f"lag={bottom / f'{lag}.json'}", f"log={tmp_path / 'rig.jsonl'}"]
    assert main(["check", f"capture={bottom / 'capture'}", f"out={tmp_path / 'out'}", *files]) == status
    made = json.loads((tmp_path / "out/check.json").read_text())
    states = {one["part"]: one["state"] for one in made["parts"]}
    assert states["clock"] == ("moved" if status else "good") and states["cam1"] == "unseen"
    assert states["probe"] in ("open", "good")
    assert len((tmp_path / "rig.jsonl").read_text().splitlines()) == 1
    page, said = (tmp_path / "out/check.html").read_text(encoding="utf-8"), capsys.readouterr().out
    assert ("Run measure-lag." in page) == bool(status) == ("Moved: scanner's clock. Run measure-lag." in said)
