"""Rows of tracked sequences: exact, read whole, and refused when damaged."""

import numpy as np

from recon.freehand import sequences
from tests.twin.experiments.asked import missed
from twin.experiments import recorded_sequences
from twin.experiments.experiment_setup import Setup


def check(function, setup=None) -> None:
    """Every bar is met."""
    assert not missed(function, function(setup))


def test_sequences_are_the_same_after_writing_and_reading():
    check(recorded_sequences.round_trip)


def test_damaged_sequences_are_refused():
    check(recorded_sequences.damaged)


def test_a_changed_pose_is_not_the_same(monkeypatch):
    """The row can fail: one number off by the last bit is seen."""
    read = sequences.read_sequence

    def nearly(path):
        frames = read(path)
        frames.transforms["ProbeToTracker"][1, 0, 0] = np.nextafter(frames.transforms["ProbeToTracker"][1, 0, 0], 2)
        return frames

    monkeypatch.setattr(sequences, "read_sequence", nearly)
    assert missed(recorded_sequences.round_trip, recorded_sequences.round_trip(None))


def test_the_real_sweep(real, rig):
    check(recorded_sequences.real_sweep, Setup(rig, real=real))
    check(recorded_sequences.real_file, Setup(rig, real=real))
