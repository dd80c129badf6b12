"""Networks of the identified twin are compared on sets that differ in the rig alone."""

import numpy as np
import pytest

from twin.experiments import drawn_rig, training_trial
from twin.experiments.training_trial import FAR_MM, Laboratory
from twin.tracking.samples import draw


def test_a_laboratory_has_its_light_and_motion_before_any_camera(rig, settings):
    """The rig's own cameras, no gain, its white; a target's way over an exposure is as long before cameras of half the pixels.

    Distances vary the way by an eighth. Without narrowing, most samples have other cameras.
    """
    laboratory, small = Laboratory(40.0, 1.5), drawn_rig.draw(rig, 3)[0]
    assert small.cam1.optics.size[0] == rig.cam1.optics.size[0] / 2
    for device in (rig, small):
        ranges = laboratory.narrowed(settings.ranges, device)
        takes = [draw(ranges, device, 0, k) for k in range(40)]
        ways = np.array([np.linalg.norm(take.motion.shift_mm[:2]) for take in takes])
        near, far = (mm / FAR_MM for mm in ranges.pose.working_mm)
        moving = ways > 0.15 * near
        assert ways.max() < 1.5 * far and ways[moving].max() > 0.8 and moving.sum() > 15
        assert all(take.cameras == (device.cam1, device.cam2) and take.gain == pytest.approx(1) for take in takes)
        assert all(40 / 1.21 < take.white_dn < 40 * 1.21 for take in takes)
        assert all(take.lighting.projector[0] == 0 for take in takes)
        wide = [draw(settings.ranges, device, 0, k) for k in range(40)]
        assert 5 < sum(take.cameras == (device.cam1, device.cam2) for take in wide) < 30


def test_gains_are_of_the_means_of_trainings():
    """The usual rig's set leaves a loss of 3 and 5, the identified's of 2 and 3, the true one's of 2 and 2."""
    losses = {"usual": (3.0, 5.0), "identified": (2.0, 3.0), "true": (2.0, 2.0)}
    found = {
        (how, name): [{"loss": one, "missed": one / 10, "missed_targets": 0.5, "centre_px": 1.0} for one in both]
        for how in ("wide", "narrow")
        for name, both in losses.items()
    }
    figures = training_trial.judge(found)
    assert figures["loss_usual_wide"] == 4 and figures["missed_identified_narrow"] == pytest.approx(0.25)
    assert figures["loss_gain_narrow"] == 1.5 and figures["loss_left_wide"] == 0.5 and figures["centre_px_gain_wide"] == 0
    assert figures["loss_between_trainings"] == pytest.approx(np.sqrt((2 + 0.5 + 0) / 3))
    assert set(training_trial.EXPERIMENT.limits) | set(training_trial.EXPERIMENT.limits.values()) <= set(figures)


def test_each_trial_has_its_own_bodies_and_crops(settings, monkeypatch):
    """Otherwise trials err alike by their few bodies, and means over them look too sure. Within a trial the twins share them."""
    pytest.importorskip("torch")
    from trainers import short_training

    taken = {}
    figures = dict.fromkeys(training_trial.FIGURES, 0.0)
    monkeypatch.setattr(training_trial, "identified", lambda rig, *_: rig)
    monkeypatch.setattr(short_training, "shipped", lambda: None)
    monkeypatch.setattr(short_training, "figures", lambda *_: figures)
    for seed in (0, 1):
        sets, crops = [], []
        monkeypatch.setattr(training_trial, "rendered", lambda rig, ranges, samples, seed, out, to=sets: to.append(seed))
        monkeypatch.setattr(short_training, "trained_on", lambda folder, steps, seed, scales, to=crops: to.append(seed))
        training_trial.measure(settings, seed)
        tried, *learnt = sets
        assert tried not in learnt and len(learnt) == 6 and len(set(learnt)) == 1
        assert len(crops) == 6 * training_trial.TRAININGS and len(set(crops)) == training_trial.TRAININGS
        taken[seed] = {tried, *learnt}, set(crops)
    assert not taken[0][0] & taken[1][0] and not taken[0][1] & taken[1][1]


@pytest.mark.slow
def test_a_twin_that_is_the_rig_gains_all_that_can_be_gained(settings, monkeypatch):
    """With the true rig for the identified one both sets, and so both networks, are the same; those of another rig aren't."""
    pytest.importorskip("torch")
    from trainers import short_training

    monkeypatch.setattr(short_training, "CROPS", 4)
    for name, value in {"SAMPLES": 2, "TRIED": 2, "STEPS": 2, "TRAININGS": 2, "VARIANTS": 1}.items():
        monkeypatch.setattr(training_trial, name, value)
    monkeypatch.setattr(training_trial, "identified", lambda rig, *_: rig)
    figures = training_trial.measure(settings, 3)
    for how in ("wide", "narrow"):
        assert figures[f"loss_left_{how}"] == 0 and figures[f"loss_gain_{how}"] != 0
    assert figures["width_px"] == 640 and 15 < figures["white_dn"] < 120
