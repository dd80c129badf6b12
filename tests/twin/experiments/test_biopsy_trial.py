"""Cores of a virtual trial: closed forms of their distances, errors that cancel, and hands as their sources have them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from recon.errors import InputError
from recon.geometry import rigid
from twin.conditions import IDEAL
from twin.experiments import biopsy_trial
from twin.experiments.biopsy_trial import HANDS, Hand, Planned
from twin.experiments.drawn_session import Drawn
from twin.experiments.experiment_runs import Biopsy, Settings
from twin.optics.surface_session import calibration_of

STILL = dict.fromkeys(Drawn.model_fields, 0.0)


@pytest.fixture(scope="module")
def trial(settings) -> Settings:
    """The trial's settings, with a needle that carries the probe's target."""
    rig = settings.rig.model_copy(update={"bodies": {"needle": settings.rig.target}})
    few = settings.noise.model_copy(update={"wires": 20, "scans": 12})
    return settings.model_copy(update={"rig": rig, "noise": few})


def test_without_errors_all_cores_are_in_the_middle():
    found = biopsy_trial.figures({"scan": np.zeros(3)}, {"hand": np.zeros((4, 3))})
    assert (found["cores"], found["within_1_mm"], found["within_3_mm"]) == (4, 4, 4)
    assert found["distance_mm"] == found["planned_mm"] == found["square_mm2"] == 0


@pytest.mark.parametrize("sigma", [0.6, 1.6])
def test_errors_alike_in_all_directions_are_maxwells(sigma, rng):
    """Shares of 20000 cores, by z-scores: 4 sigma each."""
    found = biopsy_trial.figures({"scan": np.zeros(3)}, {"hand": sigma * rng.standard_normal((20_000, 3))})
    for mm in (1, 2, 3):
        expected = stats.maxwell.cdf(mm, scale=sigma)
        score = (found[f"within_{mm}_mm"] / 20_000 - expected) / np.sqrt(expected * (1 - expected) / 20_000)
        assert abs(score) < 4
    assert found["square_mm2"] == pytest.approx(3 * sigma**2, rel=0.03)


def test_a_part_is_left_out_wherever_it_comes_from():
    """What of the rig is in plan and needle is one part; opposite errors cancel."""
    planned = {"rig": np.array([0.0, 0.0, 2.0]), "scan": np.array([1.0, 0.0, 0.0])}
    found = biopsy_trial.figures(planned, {"rig": np.tile([0.0, 0.0, -2.0], (4, 1)), "hand": np.tile([0.0, 3.0, 0.0], (4, 1))})
    assert found["square_mm2"] == pytest.approx(10) and found["planned_mm"] == pytest.approx(np.sqrt(5))
    assert [found[f"without_{name}_mm2"] for name in ("rig", "scan", "hand")] == pytest.approx([10, 9, 1])


@pytest.mark.parametrize(("training", "mean", "deviation"), [("novice", 4.26, 2.87), ("trained", 2.6, 1.1)])
def test_hands_are_as_published(training, mean, deviation, rng):
    """Mean and standard deviation of the distances of many people's aims, within 3 %."""
    hand = HANDS[training]
    skills = [biopsy_trial.skill(hand, rng) for _ in range(40_000)]
    distances = np.linalg.norm(np.array(skills)[:, None] * rng.standard_normal((40_000, 3)), axis=1)
    assert distances.mean() == pytest.approx(mean, rel=0.03) and distances.std() == pytest.approx(deviation, rel=0.03)


def test_a_wrong_scale_of_the_cameras_moves_the_tip_as_it_moves_the_plan(trial):
    """Cameras thought 1 % too far apart see all 1 % too large: the plan is 6 mm too deep, the needle stops where the mass is."""
    quiet = trial.model_copy(update={"noise": trial.noise.model_copy(update={"drawn": Drawn(**STILL)})})
    used = calibration_of(trial.rig)
    farther = used.cameras["cam2"].camera_from_world.copy()
    farther[:3, 3] *= 1.01
    known = replace(used, cameras={**used.cameras, "cam2": replace(used.cameras["cam2"], camera_from_world=farther)})
    rng = np.random.default_rng(0)
    mass = np.array([4.0, -2.0, 645.0])
    poses, tip, _ = biopsy_trial.held(mass, trial.rig.bodies["needle"], rng, 4)
    assert np.allclose([rigid.apply(pose, tip[None])[0] for pose in poses], mass)
    exact = biopsy_trial.tip_errors(quiet, Planned({}, used, used), 1, [1], poses, tip)
    assert np.abs(exact).max() < 0.02  # detectors keep a hundredth of their noise
    planned, led = 0.01 * mass, biopsy_trial.needle_errors(quiet, Planned({}, used, known), 1, [1])["rig"]
    assert np.abs(led).max() > 5.5 and np.linalg.norm(planned + led, axis=1).max() < 0.15 * np.linalg.norm(planned)


def test_without_any_error_the_needle_meets_the_mass(trial, monkeypatch):
    """From board to tip, by the real software: within 0.05 mm of a session whose detections have a hundredth of their noise."""
    for name, value in {
        "SCAN_MM": 0.0,
        "SHARE": 0.0,
        "DEFLECTION_MM": 0.0,
        "PUSHED_MM": 0.0,
        "SHIFT_MM": 0.0,
        "CORES": 2,
    }.items():
        monkeypatch.setattr(biopsy_trial, name, value)
    monkeypatch.setattr(biopsy_trial, "TOLD_M_S", biopsy_trial.speed_of("dense", np.random.default_rng(0)))
    monkeypatch.setitem(biopsy_trial.HANDS, "trained", Hand(0.0, 0.0, 0.0, 0.0))
    monkeypatch.setattr(biopsy_trial, "LIVING", biopsy_trial.LIVING.model_copy(update={"heartbeat_mm": 0.0}))
    quiet = trial.noise.model_copy(update={"drawn": Drawn(**STILL)})
    arm = Biopsy(rig="identified", tissue="dense")
    found = biopsy_trial.measure(trial.model_copy(update={"noise": quiet, "conditions": IDEAL, "biopsy": arm}), 3)
    assert found["distance_mm"] < 0.05 and found["within_1_mm"] == found["cores"] == 2


def test_a_patient_is_the_same_again_and_another_one_in_another_arm(trial, monkeypatch):
    """Also where the planned place is rendered: all else is as it was."""
    first = biopsy_trial.measure(trial, 5)
    assert biopsy_trial.measure(trial, 5) == first
    other = trial.model_copy(update={"biopsy": Biopsy(rig="worn")})
    assert biopsy_trial.measure(other, 5)["distance_mm"] != first["distance_mm"]
    monkeypatch.setattr(biopsy_trial, "rendered_place", biopsy_trial.drawn_place)
    rendered = trial.model_copy(update={"biopsy": Biopsy(measured="rendered")})
    assert biopsy_trial.measure(rendered, 5) == first


def test_gland_is_faster_than_fat_and_moves_less():
    rng = np.random.default_rng(0)
    speeds = [np.mean([biopsy_trial.speed_of(name, rng) for _ in range(500)]) for name in ("fatty", "heterogeneous", "dense")]
    assert 1440 < speeds[0] < 1450 < speeds[1] < speeds[2] < 1500


def test_a_rig_without_a_needle_is_refused(settings):
    with pytest.raises(InputError, match=r"rig\.bodies: expected needle, as in rig=three_bodies, found none"):
        biopsy_trial.target_of(settings.rig)
