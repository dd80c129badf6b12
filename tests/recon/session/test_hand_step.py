"""Films of a capture, drawn with a sensor's noise, tell the tracker's noise and the hand's motion."""

import json
from pathlib import Path

import numpy as np
import pytest

from recon.capture.manifest import CAMERAS
from recon.capture.writer import new_capture
from recon.errors import InputError
from recon.geometry import rigid
from recon.model import circle_layout
from recon.model.rig import Rig
from recon.session import hand_step
from recon.tracking import networks
from sonotwin.choices import read_rig
from sonotwin.cli import main
from tests.recon.tracking import films
from tests.recon.tracking.stand_ins import Told
from tests.twin.small_rigs import half, half_as_fields
from twin import tremor

COUNT = 44


def shaken(count: int) -> np.ndarray:
    """Poses of a hand that trembles by 0.1 mm and 0.1 deg, and is led down the image by 20 mm and back."""
    hand, poses = tremor.draw(0.1, 0.1, 12), films.places(count, (0.0, 0.0, 0.0))
    for k, pose in enumerate(poses):
        step = hand.at(k / 30)
        step[4] += 10 * (1 - np.cos(2 * np.pi * k / count))
        poses[k] = rigid.moved(pose, step)
    return poses


@pytest.fixture(scope="module")
def small(rig) -> Rig:
    return half(rig)


def write(folder, small: Rig, sweeps, count: int) -> Path:
    """A capture of films by name, each of an iterable of pairs of frames."""
    with new_capture(folder, "films") as made:
        made.add_calibration(films.optics(small))
        for name, pairs in sweeps.items():
            frames = (frame for pair in pairs for frame in zip(CAMERAS, pair, strict=True))
            made.add_sweep(dict.fromkeys(CAMERAS, films.stamps(count)), frames, films.devices(small), name=name)
    return folder


@pytest.fixture
def capture(small, tmp_path) -> Path:
    """A film of a target in a stand, and one of a target in a hand."""
    poses = {"still": films.places(COUNT, (0.0, 0.0, 0.0)), "hand": shaken(COUNT)}
    rng = np.random.default_rng(5)
    return write(tmp_path / "capture", small, {name: films.draw(small, one, rng) for name, one in poses.items()}, COUNT)


@pytest.fixture
def empty(small, tmp_path) -> Path:
    """The same of one pair each that shows nothing."""
    frame = np.full(small.cam1.optics.size[::-1], 10, np.uint8)
    return write(tmp_path / "empty", small, {name: [(frame, frame + 1)] for name in ("still", "hand")}, 1)


@pytest.fixture
def told(small, monkeypatch) -> None:
    seen = films.centres(small, films.places(1)[0])
    monkeypatch.setattr(networks, "load", lambda *_: Told(seen, small.cam1.optics.size))


@pytest.mark.slow
def test_films_tell_noise_and_tremor(capture, told, tmp_path, capsys):
    """Noise about as predicted, no drop-outs, the tremor within 3.5 sigma, and a file for `conditions=FILE`."""
    out, given = tmp_path / "ours", [*half_as_fields(read_rig()), "still=[still]", "hand=[hand]"]
    assert main(["identify", f"capture={capture}", *given, f"out={out}"]) == 0
    known = json.loads((out / "identified.json").read_text())["estimates"]
    for name in ("centre_over_predicted", "pose_over_predicted", "rays_over_predicted"):
        assert 0.6 < known[f"tracker.{name}"]["value"] < 1.4, name
    assert known["tracker.dropped"]["source"].startswith(f"0 of {2 * COUNT} pairs")
    for name in ("tremor_mm", "tremor_deg"):
        one = known[f"conditions.motion.{name}"]
        assert abs(one["value"] - 0.1) < 3.5 * one["sigma"] and one["sigma"] < 0.04
    said = capsys.readouterr().out
    assert f"tracked     still: {COUNT} of {COUNT} pairs of frames" in said
    assert "measured    conditions.motion" in said and "\n  tremor_mm " in said
    assert "bracket_deg: no calibrations of the probe" in said
    assert "tremor_mm" in (out / "conditions.yaml").read_text()


def test_what_is_wrong_is_said_in_one_line(empty, tmp_path, capsys):
    def complaint(*fields: str) -> str:
        assert main(["identify", f"capture={empty}", *fields, f"out={tmp_path / 'ours'}"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line

    assert "expected a board or a surface under fringes, found neither" in complaint()
    assert "expected the name of one of still, hand" in complaint("hand=[sweep]")
    assert "found still in both" in complaint("still=[still]", "hand=[still,hand]")


def test_probes_come_in_pairs(tmp_path):
    with pytest.raises(InputError, match="expected two of each session, before and after it, found 1"):
        hand_step.compare_probes([tmp_path / "probe.yaml"])


def test_a_hand_shakes_a_probe_about_its_array(empty, rig):
    """Of films without B-scans, about the circles' middle."""
    assert hand_step.shaken_point(empty, "hand", rig) == pytest.approx(circle_layout.middle(rig.target))
