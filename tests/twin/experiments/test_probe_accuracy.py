"""The rows of the probe's calibration in reduced form: on rendered wires a few, on exact crossings all."""

from dataclasses import replace

import numpy as np
import pytest

from recon.probe_calibration import point_calibration
from recon.probe_calibration.point_calibration import Sightings
from scenes.kinds import crosswire
from tests.twin.experiments import asked
from twin.experiments import probe_accuracy
from twin.experiments.experiment_setup import Setup
from twin.ultrasound.echo_solids import body
from twin.ultrasound.probe_path import held
from twin.ultrasound.transducer import Transducer

WATER = Transducer(gain_db=-40.0, tgc_db_per_cm_mhz=0.0165)  # as conf/ultrasound/water.yaml
COUNT = 90  # three calibrations


@pytest.fixture
def setup(rig, monkeypatch) -> Setup:
    monkeypatch.setattr(probe_accuracy, "REPEATS", 1)
    return Setup(rig, {}, scanners={"water": WATER})


def exact_frames(count: int, error_px=(0.0, 0.0)) -> probe_accuracy.Frames:
    """The frames of the protocol without B-scans: crossings where they are, but for a common error."""
    wired = body(crosswire.build(crosswire.Config()))
    turns, pixels = point_calibration.motion(WATER.image_size, count, roll_deg=probe_accuracy.ROLL_DEG)
    poses = held(wired, WATER, turns, pixels, np.zeros(count))
    ahead = [0, 0.0428 / (WATER.scale_mm_per_px[1] * wired.medium.speed / WATER.assumed_speed)]
    found = Sightings(poses, pixels - ahead + error_px)
    return probe_accuracy.Frames(poses, found, np.arange(count), pixels, np.zeros(count))


def missed(function, setup, frames) -> list[str]:
    return [row.what for row in asked.missed(function, function(setup, frames))]


def test_the_crossing_of_rendered_wires_is_found(rig):
    """Lines meet within 0.4 mm of where the midpoint between the axes is, and most images are used."""
    frames = probe_accuracy.recorded(rig, WATER, 12)
    error = frames.found.pixels - frames.pixels[frames.numbers]
    assert len(frames.numbers) >= 8
    assert (np.abs(error) < [3.5, 3]).all()
    assert 0.05 < np.abs(frames.beside).mean() < 0.4  # a hand misses the plane, by as much as the path says


def test_exact_crossings_meet_all_bars(setup):
    """With 0.08 deg and 0.05 mm of the poses alone: repeats, true error, and, of water, the speed of sound."""
    frames = exact_frames(COUNT)
    assert not [what for what in missed(probe_accuracy.repeats, setup, frames) if "squared error" not in what]
    assert not missed(probe_accuracy.sound, setup, frames)


def test_a_common_error_of_crossings_is_seen_in_the_truth_only(setup):
    """All crossings 4 px too deep: the calibrations agree as before, and are wrong."""
    wrong = missed(probe_accuracy.repeats, setup, exact_frames(COUNT, error_px=(0, 4)))
    assert not [what for what in wrong if "CR" in what]
    assert {"true error, median", "true error, worst"} <= {what.split(": ")[-1] for what in wrong}


def test_repeats_do_not_narrow_the_interval_of_the_squared_error(setup, monkeypatch):
    """They share their images: two sets, 16 degrees of freedom, however often the poses' errors are drawn."""
    frames, low_high = exact_frames(60), []
    once = probe_accuracy.sets(setup.rig, frames, 1)
    for name, (found, *_) in zip(("calibrated", "calibrated_exactly"), (one[0] for one in once), strict=True):
        monkeypatch.setattr(probe_accuracy, name, lambda *_, found=found: found)
    for repeats in (1, 3):
        monkeypatch.setattr(probe_accuracy, "REPEATS", repeats)
        rows = asked.rows(probe_accuracy.repeats, probe_accuracy.repeats(setup, frames))[-2:]
        assert all(f"{2 * repeats} calibrations of 2 sets" in row.what for row in rows)
        low_high.append([row.bar for row in rows])
    assert low_high[0] == low_high[1] == pytest.approx([6.908 / 16, 28.845 / 16], abs=1e-3)  # of tables of chi-square


def test_faults_are_refused_by_name(setup, monkeypatch):
    """A planar motion is of rendered wires at full size; here of exact crossings."""
    turns = np.outer(np.linspace(-35, 35, 20), [1.0, 0, 0])
    _, pixels = point_calibration.motion(WATER.image_size, 20)
    wired = body(crosswire.build(crosswire.Config()))
    flat = Sightings(held(wired, WATER, turns, pixels, np.zeros(20)), pixels)
    monkeypatch.setattr(probe_accuracy, "planar", lambda setup: flat)
    assert not missed(probe_accuracy.refusals, setup, exact_frames(60))


def test_what_is_not_refused_counts_as_missed():
    assert probe_accuracy.refused(lambda: None, "planar motion") == 0


def test_outliers_are_anywhere_and_as_many_as_said(rig, rng):
    frames = exact_frames(30)
    spoilt = probe_accuracy.with_outliers(frames.found, rig.probe.image_size, rng)
    assert (np.linalg.norm(spoilt.pixels - frames.found.pixels, axis=1) > 0).sum() == 9


def test_frames_without_a_crossing_are_not_replaced():
    """A calibration has its own 30 images, however many show the crossing."""
    frames = replace(exact_frames(60), numbers=np.array([0, 3, 29, 30, 59]))
    assert [block.tolist() for block in probe_accuracy.blocks(frames)] == [[0, 1, 2], [3, 4]]
